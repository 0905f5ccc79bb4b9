"""Jumps and occlusions of a pose tracker are marked and left out, held against the mock's truth."""

import math
from operator import methodcaller

import numpy as np
import pytest

from dextouch.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from dextouch.streams import StreamDescriptor
from services.acquisition.devices.pose_tracker import (
    PoseGate,
    PoseTrackerDecoder,
    TrackingState,
)
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.mocks.replay import ReplayStream
from services.acquisition.mocks.trackers_and_cameras import PoseTrackerSource

PERIOD_NS = 10_000_000
BOOT_NS = 10_000_000_000_000
UNIT = (1.0, 0.0, 0.0, 0.0)
NOTHING = {"occluded": 0, "jumped": 0, "stale": 0}


def turned(start_s, stop_s, turn_rad):
    """The tracker says it runs for a while, but its pose is turned by this much."""

    def turn(tracked):
        during = tracked._labelled(start_s, stop_s, "jumped")
        R_world_body = rotation_from_quaternion(tracked.poses[during, 3:])
        R = rotation_from_vector(np.array(turn_rad)) @ R_world_body
        tracked.poses[during, 3:] = quaternion_from_rotation(R)

    return turn


def brisk_stream(seconds=4.0):
    """A hand shaken at 2 Hz: up to 2 m/s and 7.5 rad/s."""
    t_ns = np.arange(round(seconds * 100), dtype=np.int64) * PERIOD_NS
    turn_rad = 2 * np.pi * 2.0 * t_ns / 1e9
    poses = np.zeros((len(t_ns), 7))
    poses[:, :3] = np.array([0.3, 0.2, 1.0]) + 0.16 * np.sin(turn_rad)[:, None] * [1, 0, 0]
    vectors_rad = 0.6 * np.sin(turn_rad)[:, None] * np.array([0.0, 0.6, 0.8])
    poses[:, 3:] = quaternion_from_rotation(rotation_from_vector(vectors_rad))
    descriptor = StreamDescriptor(
        name="wrist_left",
        kind="pose",
        shape=(7,),
        dtype="float64",
        unit="pose_m_wxyz",
        nominal_rate_hz=100,
    )
    return ReplayStream(descriptor, t_ns, poses)


def play(tracking=(), faults=None, order=None, step_ns=lambda index: 0):
    faults = faults or DeviceFaults()
    source = PoseTrackerSource(brisk_stream(), faults=faults, rng=np.random.default_rng(3))
    for disturb in tracking:
        disturb(source)
    decoder = PoseTrackerDecoder("wrist_left")
    samples = []
    for index in order or range(len(source.t_ns)):
        t_device_ns = BOOT_NS + int(source.t_ns[index]) + step_ns(index)
        for report in source.units(index, index, t_device_ns):
            samples += decoder.decode(report, int(source.t_ns[index])).get("wrist_left", [])
    return source, decoder, samples


def test_brisk_motion_with_noise_is_all_kept():
    faults = FaultScript.first_light().of("pose_tracker_wrist_left")
    tracked, decoder, samples = play(faults=faults)
    assert len(samples) == len(tracked.t_ns)
    assert decoder.tracking == NOTHING


@pytest.mark.parametrize("state", [s for s in TrackingState if s != TrackingState.RUNNING_OK])
def test_occlusion_is_counted_and_a_gap(state):
    tracked, decoder, samples = play([methodcaller("lose", 1.0, 1.5, state)])
    assert [s.sequence for s in samples] == np.flatnonzero(tracked.labels == "").tolist()
    assert decoder.tracking == NOTHING | {"occluded": 50}


@pytest.mark.parametrize(
    "jump",
    [
        methodcaller("move", 1.0, 1.03, offset_m=(0.5, 0.0, 0.0)),
        methodcaller("move", 1.0, 1.01, offset_m=(0.0, 0.0, -0.12)),
        turned(1.0, 1.02, (0.0, 0.0, 1.2)),
        turned(1.0, 1.04, (math.pi - 0.1, 0.0, 0.0)),
    ],
)
def test_jump_is_counted_and_a_gap(jump):
    tracked, decoder, samples = play([jump])
    assert [s.sequence for s in samples] == np.flatnonzero(tracked.labels == "").tolist()
    assert decoder.tracking == NOTHING | {"jumped": (tracked.labels == "jumped").sum()}


def test_nothing_is_invented_or_repeated():
    tracking = [
        methodcaller("lose", 0.5, 0.8),
        methodcaller("move", 1.0, 1.05, offset_m=(1.0, 0.0, 0.0)),
        methodcaller("lose", 2.0, 2.01),
    ]
    tracked, decoder, samples = play(tracking)
    sent = {pose.astype(np.float32)[:3].tobytes() for pose in tracked.poses[tracked.labels == ""]}
    got = [sample.values.astype(np.float32)[:3].tobytes() for sample in samples]
    assert set(got) <= sent
    assert len({sample.sequence for sample in samples}) == len(samples)
    assert decoder.tracking == {"occluded": 31, "jumped": 5, "stale": 0}


def test_a_tracker_that_really_moved_is_believed_once_it_can_be_there():
    # Set up anew 1 m away: reachable at 5 m/s after 0.2 s, and then kept for good.
    _, decoder, samples = play([methodcaller("move", 1.0, 9.0, offset_m=(0.0, 1.0, 0.0))])
    sequences = [s.sequence for s in samples]
    lost = sorted(set(range(400)) - set(sequences))
    assert lost == list(range(100, lost[-1] + 1))
    assert 18 <= len(lost) <= 20
    assert decoder.tracking == NOTHING | {"jumped": len(lost)}


def test_the_origin_is_no_pose_however_long_it_is_sent():
    stream = brisk_stream()
    source = PoseTrackerSource(stream, faults=DeviceFaults(), rng=np.random.default_rng(0))
    source.poses[200:300] = [0, 0, 0, 1, 0, 0, 0]
    decoder = PoseTrackerDecoder("wrist_left")
    sequences = [
        sample.sequence
        for index in range(400)
        for report in source.units(index, index, int(source.t_ns[index]))
        for sample in decoder.decode(report, 0).get("wrist_left", [])
    ]
    assert sequences == [*range(200), *range(300, 400)]
    assert decoder.tracking["jumped"] == 100


@pytest.mark.parametrize("step_s", [-3600.0, -0.03, 0.2, 10.0])
def test_a_step_of_the_device_clock_is_no_jump(step_s):
    step_ns = round(step_s * 1e9)
    tracked, decoder, samples = play(step_ns=lambda index: (index >= 150) * step_ns)
    assert len(samples) == len(tracked.t_ns)
    assert decoder.tracking["jumped"] == 0


def test_a_clock_step_during_a_jump_does_not_shut_the_gate():
    jump = methodcaller("move", 1.0, 1.1, offset_m=(1.0, 0.0, 0.0))
    _, decoder, samples = play([jump], step_ns=lambda index: (index >= 105) * -BOOT_NS)
    assert samples[-1].sequence == 399
    assert decoder.tracking["jumped"] == 10


def test_repeated_and_late_packets_become_no_sample():
    order = [0, 1, 1, 2, 4, 3, 5, *range(6, 50)]
    _, decoder, samples = play(order=order)
    assert [s.sequence for s in samples] == [0, 1, 2, 4, 5, *range(6, 50)]
    assert (decoder.statistics.repeated, decoder.statistics.late) == (1, 1)


def test_a_restarted_tracker_goes_on():
    order = [*range(100), *range(100)]
    _, _, samples = play(order=order)
    assert [s.sequence for s in samples[100:]] == list(range(100 - len(samples[:100]), 100))
    assert len(samples) == 200


def admitted_after(pose, next_pose):
    """Whether the gate lets `next_pose` pass one period after `pose`."""
    gate = PoseGate(dict(NOTHING))
    first, second = (
        gate.take(tried, sequence=index, t_device_ns=index * PERIOD_NS, t_host_ns=0)
        for index, tried in enumerate((pose, next_pose))
    )
    assert first is not None
    return second is not None


def test_the_negative_quaternion_is_the_same_rotation():
    assert admitted_after((0.1, 0.2, 0.3, *UNIT), (0.1, 0.2, 0.3, *(-q for q in UNIT)))


@pytest.mark.parametrize(("speed_m_per_s", "admitted"), [(4.99, True), (5.01, False)])
def test_the_limit_of_speed(speed_m_per_s, admitted):
    moved = (1.0 + speed_m_per_s * 0.01, 0.0, 0.0, *UNIT)
    assert admitted_after((1.0, 0.0, 0.0, *UNIT), moved) is admitted


@pytest.mark.parametrize(("rate_rad_per_s", "admitted"), [(34.8, True), (35.0, False)])
def test_the_limit_of_turning(rate_rad_per_s, admitted):
    half_rad = rate_rad_per_s * 0.01 / 2
    turned = (math.cos(half_rad), 0.0, math.sin(half_rad), 0.0)
    assert admitted_after((1.0, 0.0, 0.0, *UNIT), (1.0, 0.0, 0.0, *turned)) is admitted


def test_a_new_link_starts_from_nothing():
    decoder = play()[1]
    decoder.reset()
    source = PoseTrackerSource(
        brisk_stream(),
        faults=DeviceFaults(),
        rng=np.random.default_rng(3),
    )
    source.move(0.0, 9.0, offset_m=(50.0, 0.0, 0.0))
    (report,) = source.units(0, 399, 7)
    assert len(decoder.decode(report, 0)["wrist_left"]) == 1
