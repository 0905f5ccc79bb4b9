"""Trackers behind bridges: frames against closed forms, gates against the mock's truth."""

import itertools
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import DeviceError, PacketError, StaleDataError
from dextouch.geometry import pose_from_transform
from dextouch.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from dextouch.hands import NODES
from services.acquisition.clock import VirtualClock
from services.acquisition.devices.finger_tracker import BridgeFingerTrackerDecoder
from services.acquisition.devices.pose_tracker import (
    POSE_PAYLOAD,
    BridgePoseTrackerDecoder,
    SenderFrame,
    TrackingResult,
    quaternion_of_one,
)
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.sdk_link import BridgeDriver, FrameConvention
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.trackers_and_cameras import (
    LEFT_HANDED,
    POSE_INDEX,
    Y_UP,
    BridgeFingerTrackerSource,
    BridgePort,
    BridgePoseSource,
)

MS = 1_000_000
BOOT_NS = 7_000_000_000_000
STREAMS = {stream.descriptor.name: stream for stream in pattern_streams(2.0)}


def fingers(side="left", seed=1, **settings):
    rng = np.random.default_rng(seed)
    source = BridgeFingerTrackerSource(STREAMS[f"keypoints_{side}"], side=side, rng=rng)
    vars(source).update(settings)
    return source


def hello_with(source, **changes):
    """The first line of a source's bridge, which says something else."""
    return json.dumps({**json.loads(source.hello), **changes}).encode() + b"\n"


def poses(stream="wrist_left", **settings):
    rng = np.random.default_rng(1)
    source = BridgePoseSource(STREAMS[stream], faults=DeviceFaults(), rng=rng)
    vars(source).update(settings)
    return source


def play(source, decoder, delay_ns=lambda index: 2 * MS):
    (stream,) = (descriptor.name for descriptor in decoder.descriptors)
    assert decoder.decode(source.hello, 0) == {}
    samples = []
    for index, t_ns in enumerate(source.t_ns):
        for unit in source.units(index, index, BOOT_NS + int(t_ns)):
            t_host_ns = 10**9 + int(t_ns) + delay_ns(index)
            samples += decoder.decode(unit, t_host_ns).get(stream, [])
    return samples


def matrix_of(R, t=(0.0, 0.0, 0.0)):
    return np.concatenate([R, np.array(t)[:, None]], axis=1)


def about(axis, angle_rad):
    half_rad = angle_rad / 2
    q_wxyz = np.zeros(4)
    q_wxyz[0], q_wxyz[1 + axis] = math.cos(half_rad), math.sin(half_rad)
    return q_wxyz


OURS = FrameConvention(handedness="right", axes=("+x", "+y", "+z"))


def converted(convention, matrix, *, scale_m=1.0):
    """A sender's matrix [R | t] as our pose."""
    return np.array(SenderFrame(convention, scale_m).pose(matrix.ravel().tolist()))


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle_rad", [0.3, -1.1, 2.9])
def test_left_handed_rotations(axis, angle_rad):
    # Turning z round mirrors turns about x and y, and leaves those about z.
    R = rotation_from_vector(angle_rad * np.eye(3)[axis])
    pose = converted(LEFT_HANDED, matrix_of(R, (10.0, 20.0, 30.0)), scale_m=0.01)
    np.testing.assert_allclose(pose[:3], [0.1, 0.2, -0.3], atol=1e-15)
    sign = 1.0 if axis == 2 else -1.0
    np.testing.assert_allclose(pose[3:], about(axis, sign * angle_rad), atol=1e-12)


@pytest.mark.parametrize(
    ("axis", "ours", "sign"), [(0, 0, 1.0), (1, 2, 1.0), (2, 1, -1.0)], ids=["x", "y", "z"]
)
def test_y_up_rotations(axis, ours, sign):
    # Their y is our z, their z our −y: a turn about one is a turn about the other.
    R = rotation_from_vector(0.7 * np.eye(3)[axis])
    pose = converted(Y_UP, matrix_of(R, (1.0, 2.0, 3.0)))
    np.testing.assert_allclose(pose[:3], [1.0, -3.0, 2.0], atol=1e-15)
    np.testing.assert_allclose(pose[3:], about(ours, sign * 0.7), atol=1e-12)


def test_a_chain_of_frames_is_kept(rng):
    # Conversion and composition commute, whatever the handedness.
    M = LEFT_HANDED.ours_from_theirs()
    R_a, R_b = (rotation_from_vector(rng.normal(size=3)) for _ in range(2))
    q_ab_wxyz = converted(LEFT_HANDED, matrix_of(R_a @ R_b))[3:]
    T = [np.eye(4) for _ in range(2)]
    for transform, R in zip(T, (M @ R_a @ M.T, M @ R_b @ M.T), strict=True):
        transform[:3, :3] = R
    product = pose_from_transform(T[0] @ T[1])[3:]
    assert abs(abs(product @ q_ab_wxyz) - 1.0) < 1e-12


@pytest.mark.parametrize(
    "R",
    [
        np.diag([1.0, 1.0, -1.0]),
        1.01 * np.eye(3),
        np.zeros((3, 3)),
        np.full((3, 3), np.nan),
        np.array([[1.0, 0.01, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    ],
)
def test_matrices_that_are_no_rotation_are_refused(R):
    with pytest.raises(PacketError, match="pose matrix"):
        converted(OURS, matrix_of(R))


@given(
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 1e-3),
    st.sampled_from([0.0, 1e-9, 1e-4, 0.5, 2.0, math.pi - 1e-7, math.pi]),
)
def test_the_quaternion_of_one_is_the_reference_one(axis, angle_rad):
    vector_rad = angle_rad / math.hypot(*axis) * np.array(axis)
    R = rotation_from_vector(vector_rad)
    q_wxyz, reference = np.array(quaternion_of_one(R.tolist())), quaternion_from_rotation(R)
    # At half a turn both signs are the same rotation, and which one is rounding.
    sign = 1.0 if q_wxyz @ reference > 0 else -1.0
    np.testing.assert_allclose(sign * q_wxyz, reference, atol=1e-14)
    assert sign > 0 or abs(reference[0]) < 1e-9


def all_conventions():
    """The 48 ways in which three axes can lie along ours."""
    for names in itertools.permutations("xyz"):
        for signs in itertools.product("+-", repeat=3):
            axes = tuple(sign + name for sign, name in zip(signs, names, strict=True))
            matrix = np.zeros((3, 3))
            for column, (sign, name) in enumerate(axes):
                matrix["xyz".index(name), column] = 1.0 if sign == "+" else -1.0
            handedness = "right" if np.linalg.det(matrix) > 0 else "left"
            yield FrameConvention(handedness=handedness, axes=axes)


@pytest.mark.long
@pytest.mark.parametrize("convention", list(all_conventions()), ids=lambda c: "".join(c.axes))
def test_the_frame_of_a_sender_is_the_product_of_matrices(convention):
    rng = np.random.default_rng(4)
    vectors_rad = [*rng.normal(0, 2, (20, 3)), *math.pi * np.eye(3), *np.eye(3), np.zeros(3)]
    for vector_rad in vectors_rad:
        matrix = matrix_of(rotation_from_vector(vector_rad), rng.normal(0, 3, 3))
        pose, M = converted(convention, matrix, scale_m=0.01), convention.ours_from_theirs()
        np.testing.assert_allclose(pose[:3], 0.01 * M @ matrix[:, 3], atol=1e-15)
        R_ours = rotation_from_quaternion(pose[3:])
        np.testing.assert_allclose(R_ours, M @ matrix[:, :3] @ M.T, atol=1e-14)
        # No −0, on which signs would hang.
        assert not np.any((pose == 0) & np.signbit(pose))


@pytest.mark.parametrize("place", range(12))
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_matrix_with_a_number_that_is_none_is_refused(place, number):
    numbers = matrix_of(np.eye(3)).ravel().tolist()
    numbers[place] = number
    with pytest.raises(PacketError, match="NaN or infinity"):
        SenderFrame(Y_UP, 1.0).pose(numbers)


@pytest.mark.parametrize("frame", [Y_UP, LEFT_HANDED])
def test_poses_arrive_as_they_are(frame):
    source, decoder = poses(frame=frame), BridgePoseTrackerDecoder("wrist_left")
    samples = play(source, decoder)
    got, sent = np.array([s.values for s in samples]), STREAMS["wrist_left"].values
    np.testing.assert_allclose(got, sent, atol=2e-7)
    # The stamps are the SDK's seconds, to the nanosecond.
    assert [s.t_device_ns for s in samples] == (BOOT_NS + source.t_ns).tolist()
    assert not any(decoder.tracking.values())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "frame", [LEFT_HANDED, FrameConvention(handedness="right", axes=("-y", "+z", "-x"))]
)
def test_hands_arrive_as_they_are(seed, frame):
    source = fingers(seed=seed, frame=frame)
    samples = play(source, BridgeFingerTrackerDecoder("left"))
    got, sent = np.array([s.values for s in samples]), STREAMS["keypoints_left"].values
    np.testing.assert_allclose(got, sent, atol=3e-8)
    assert got.dtype == np.float32


def test_only_the_running_result_counts():
    source, decoder = poses(), BridgePoseTrackerDecoder("wrist_left")
    source.lose(0.5, 0.8)
    samples = play(source, decoder)
    # The flag was set all the time.
    assert [s.sequence for s in samples] == np.flatnonzero(source.labels == "").tolist()
    assert decoder.tracking == {"occluded": 30, "jumped": 0, "stale": 0}


@pytest.mark.parametrize("result", [r for r in TrackingResult if r != 200] + [0, 199, 201])
@pytest.mark.parametrize("flag", [0, 1])
def test_no_flag_makes_a_sample(result, flag):
    decoder = BridgePoseTrackerDecoder("wrist_left")
    decoder.decode(poses().hello, 0)
    assert decoder.decode(pose_packet(result=result, flag=flag), 1) == {}
    assert decoder.tracking["occluded"] == 1


def pose_packet(result=200, flag=1, seconds=1.0, R=None, index=POSE_INDEX, source="left"):
    numbers = matrix_of(np.eye(3) if R is None else R, (0.1, 0.2, 0.3)).ravel()
    payload = POSE_PAYLOAD.pack(index, flag, result, seconds, *numbers)
    return encode_packet(b"DXPM", Packet(1, SOURCES[source], 0, 0, payload))


def test_a_running_pose_that_is_flagged_invalid_is_left_out():
    decoder = BridgePoseTrackerDecoder("wrist_left")
    decoder.decode(poses().hello, 0)
    assert decoder.decode(pose_packet(flag=0), 1) == {}


@pytest.mark.parametrize(
    "damage",
    [
        {"R": 2 * np.eye(3)},
        {"R": np.full((3, 3), np.nan)},
        {"seconds": math.nan},
        {"seconds": -1.0},
        {"seconds": 1e12},
    ],
)
def test_poses_that_are_none_are_refused_and_counted(damage):
    decoder = BridgePoseTrackerDecoder("wrist_left")
    decoder.decode(poses().hello, 0)
    assert decoder.decode(pose_packet(**damage), 1) == {}
    assert decoder.statistics.refused == 1


def test_other_devices_of_the_bridge_are_not_ours():
    decoder = BridgePoseTrackerDecoder("wrist_left")
    decoder.decode(poses().hello, 0)
    assert decoder.decode(pose_packet(index=POSE_INDEX + 1), 1) == {}
    assert not any(decoder.tracking.values())


def test_jumps_are_marked():
    source = poses()
    source.move(1.0, 1.02, offset_m=(0.0, 0.3, 0.0))
    decoder = BridgePoseTrackerDecoder("wrist_left")
    samples = play(source, decoder)
    assert [s.sequence for s in samples] == np.flatnonzero(source.labels == "").tolist()
    assert decoder.tracking == {"occluded": 0, "jumped": 2, "stale": 0}


@pytest.mark.parametrize("kind", ["fingers", "poses"])
def test_old_data_is_left_out_and_marked(kind):
    source = fingers() if kind == "fingers" else poses()
    decoder = (
        BridgeFingerTrackerDecoder("left")
        if kind == "fingers"
        else BridgePoseTrackerDecoder("wrist_left")
    )
    samples = play(source, decoder, lambda index: (350 if 50 <= index < 60 else 2) * MS)
    assert [s.sequence for s in samples] == [*range(50), *range(60, len(source.t_ns))]
    assert decoder.tracking == {"occluded": 0, "jumped": 0, "stale": 10}


def test_two_hands_of_one_bridge_are_told_apart():
    left, right = fingers("left"), fingers("right")
    devices = [*json.loads(left.hello)["devices"], *json.loads(right.hello)["devices"]]
    hello = hello_with(left, devices=[{**d, "index": i} for i, d in enumerate(devices)])
    decoder = BridgeFingerTrackerDecoder("left")
    data = hello + left.units(0, 0, 1)[0] + right.units(0, 1, 2)[0] + left.units(1, 2, 3 * MS)[0]
    samples = decoder.decode(data, 10 * MS)["keypoints_left"]
    assert [s.sequence for s in samples] == [0, 2]
    assert decoder.statistics.lost == 0


def test_a_hand_that_was_not_announced_is_refused():
    decoder = BridgeFingerTrackerDecoder("left")
    with pytest.raises(DeviceError, match="'right'"):
        decoder.decode(fingers("left").hello + fingers("right").units(0, 0, 1)[0], 1)


@pytest.mark.parametrize(
    ("nodes", "words"),
    [
        (NODES[1:], "missing"),
        ((*NODES[:-1], NODES[0]), "named twice"),
        ((*NODES[:-1], ("thumb", "intermediate")), "unknown"),
    ],
)
def test_nodes_that_are_not_the_25_are_refused(nodes, words):
    hello = hello_with(fingers(), nodes=nodes)
    with pytest.raises(DeviceError, match=words) as caught:
        BridgeFingerTrackerDecoder("left").decode(hello, 1)
    assert caught.value.details["event"] == "wrong_nodes"


class Stage:
    """A bridge on a virtual clock, and its driver."""

    def __init__(self):
        self.source = poses()
        self.clock = VirtualClock()
        self.port = BridgePort("mock", self.source.hello)
        self.port.plug()
        self.driver = BridgeDriver(
            "pose_tracker_wrist_left",
            transport=self.port.transport,
            decoder=BridgePoseTrackerDecoder("wrist_left"),
            clock=self.clock,
        )

    def pass_time(self, step_ns):
        waiter = self.clock.waiter(drives_time=True)
        assert waiter.wait_until(self.clock.now_ns() + step_ns)
        waiter.close()

    def close(self):
        self.driver.close()
        self.port.unplug()


@pytest.fixture
def stage():
    built = Stage()
    yield built
    built.close()


def test_silence_is_loss_after_200_ms(stage):
    stage.driver.open()
    stage.pass_time(200 * MS)
    assert stage.driver.read() == {}
    stage.pass_time(1)
    with pytest.raises(StaleDataError, match="sent nothing for 200 ms"):
        stage.driver.read()


def test_a_sign_of_life_is_no_sample_but_ends_the_silence(stage):
    stage.driver.open()
    for sequence in range(6):
        stage.pass_time(190 * MS)
        life = Packet(VERSION, SOURCES["none"], sequence, sequence, b"")
        stage.port.send(encode_packet(b"DXPM", life))
        assert stage.driver.read() == {}
    assert stage.driver.statistics.packets == 6


def test_a_reader_that_was_held_up_after_its_wait_takes_no_living_bridge_for_lost(
    stage, monkeypatch
):
    stage.driver.open()
    read = stage.port.transport.read

    def held_up():
        data = read()
        stage.pass_time(300 * MS)
        return data

    monkeypatch.setattr(stage.port.transport, "read", held_up)
    assert stage.driver.read() == {}
    stage.port.send(stage.source.units(0, 0, 5)[0])
    assert list(stage.driver.read()) == ["wrist_left"]


def test_samples_that_come_with_the_hello_are_not_lost(stage):
    hello, (unit,) = stage.source.hello, stage.source.units(0, 0, 5)
    stage.port.hello = hello + unit
    stage.driver.open()
    (sample,) = stage.driver.read()["wrist_left"]
    assert sample.sequence == 0


def test_a_bridge_without_a_hello_is_refused(stage, monkeypatch):
    monkeypatch.setattr("services.acquisition.drivers.sdk_link.HELLO_READS", 2)
    stage.port.hello = b"{"
    with pytest.raises(DeviceError, match="no hello"):
        stage.driver.open()
