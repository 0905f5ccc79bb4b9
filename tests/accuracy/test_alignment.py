"""A simulated station's recording through alignment, against the truth that it saw."""

import sys

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import ClockFitError, InvalidInputError, NotFoundError
from dextouch.geometry import transform_from_pose
from dextouch.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from dextouch.hands.actions import HandTrajectory, actions_from_poses
from dextouch.hands.robot_hand import RobotHand
from dextouch.schemas import EpisodeAttributes, RecordingAttributes, StoredAnchor, matrix_rows
from dextouch.streams import ClockCapabilities, StreamDescriptor
from dextouch.tactile.layout import expand_taxels
from services.alignment.jobs import align_recording
from services.alignment.recording_error import compare_with_truth
from services.alignment.settings import AlignmentOptions
from services.twin.hands import HumanHand

DURATION_S = 80 / 15
START_HOST_NS = 7_000_000_000_000
K_HEAD = ((10.0, 0.0, 4.0), (0.0, 10.0, 4.0), (0.0, 0.0, 1.0))
SIDES = ("left", "right")
LATENCY_MS = {"tactile": 2.0, "keypoints": 3.0, "pose": 4.0, "image": 21.0, "robot_state": 1.0}
CAPABILITIES = ClockCapabilities(crc=True, sequence=True, device_time=True)


def descriptor(name, kind, shape, dtype, unit, rate_hz):
    side = next((side for side in SIDES if side in name), None)
    return StreamDescriptor(
        name=name,
        kind=kind,
        shape=shape,
        dtype=dtype,
        unit=unit,
        nominal_rate_hz=rate_hz,
        side=side,
        capabilities=CAPABILITIES,
    )


def times_ns(rate_hz):
    return np.rint(np.arange(int(DURATION_S * rate_hz + 1e-9) + 1) * 1e9 / rate_hz).astype(np.int64)


def wave(t_ns, num, seed, *, rate_hz=0.7):
    rng = np.random.default_rng(seed)
    phase = 2 * np.pi * rng.random(num)
    return np.sin(2 * np.pi * rng.uniform(0.3, 1.0, num) * rate_hz * t_ns[:, None] * 1e-9 + phase)


def poses(t_ns, seed):
    turns = 0.6 * wave(t_ns, 3, seed)
    q = quaternion_from_rotation(rotation_from_vector(turns))
    return np.concatenate([0.15 * wave(t_ns, 3, seed + 50), q], axis=1)


def joints(hand, t_ns, seed):
    middle, half = 0.5 * (hand.lower_rad + hand.upper_rad), 0.5 * (hand.upper_rad - hand.lower_rad)
    return middle + 0.5 * half * wave(t_ns, 20, seed)


def pressures(t_ns, seed):
    """Smooth patches that come and go."""
    taxels = np.arange(320)
    centre = 160 + 150 * wave(t_ns, 1, seed)
    strength = 30 * np.maximum(wave(t_ns, 1, seed + 9), 0)
    return (strength * np.exp(-(((taxels - centre) / 12) ** 2))).astype(np.float32)


def truth_streams(domain):
    """name → (descriptor, times, values) of everything but the actions."""
    streams = {}

    def add(name, kind, values, unit, rate_hz):
        stream = descriptor(name, kind, values.shape[1:], values.dtype.name, unit, rate_hz)
        streams[name] = (stream, times_ns(rate_hz), values)

    for seed, side in enumerate(SIDES):
        add(f"tactile_{side}", "tactile", pressures(times_ns(60), seed + 1), "kPa", 60)
        add(f"wrist_{side}", "pose", poses(times_ns(100), seed + 10), "pose_m_wxyz", 100)
        if domain == "human":
            hand = HumanHand(side)
            keypoints = hand.keypoints_m(joints(hand, times_ns(120), seed + 20))
            add(f"keypoints_{side}", "keypoints", keypoints, "m", 120)
        else:
            commanded = poses(times_ns(100) + 30_000_000, seed + 10)
            add(f"wrist_{side}_commanded", "pose", commanded, "pose_m_wxyz", 100)
    if domain == "robot":
        for name, delay_ns in (("joints_measured", 0), ("joints_commanded", 30_000_000)):
            t_ns = times_ns(100) + delay_ns
            both = [joints(RobotHand(side), t_ns, seed + 20) for seed, side in enumerate(SIDES)]
            add(name, "robot_state", np.concatenate(both, axis=1), "rad", 100)
    add("head", "pose", poses(times_ns(100), 33), "pose_m_wxyz", 100)
    images = np.random.default_rng(4).integers(0, 255, (len(times_ns(30)), 8, 8, 3), dtype=np.uint8)
    add("camera_head", "image", images, "rgb8", 30)
    return streams


def write_truth(store, domain):
    streams = truth_streams(domain)
    start = [transform_from_pose(streams[n][2]) for n in ("wrist_left", "wrist_right", "head")]
    zero = np.zeros((1, 20))
    trajectory = HandTrajectory(start[0][:1], start[1][:1], zero, zero, start[2][:1])
    attributes = EpisodeAttributes(
        episode_id=f"truth-{domain}",
        task="stand-bottle",
        instruction="stand the bottle up",
        domain=domain,
        origin="twin",
        anchor=StoredAnchor.from_poses(trajectory.anchor(0)),
        K_head=K_HEAD,
    )
    with store.writer(kind="episode", attributes=attributes) as writer:
        for stream, t_ns, values in streams.values():
            writer.add_stream(stream)
            writer.append(stream.name, values=values, t_ref_ns=t_ns)
    return streams


def as_recorded(stream, t_ns, values, rng):
    """What the station stores of one stream: noise, counts, delays, skew, drops."""
    calibration = {}
    if stream.kind == "tactile":
        tare, gain = rng.uniform(110, 130, 360), rng.uniform(38, 42, 360)
        raw = expand_taxels(values.astype(np.float64), side=stream.side)
        values = np.rint(tare + gain * raw).astype(np.uint16)
        calibration[f"{stream.name}_tare_counts"] = matrix_rows(tare[None])
        calibration[f"{stream.name}_gain_counts_per_kpa"] = matrix_rows(gain[None])
        stream = descriptor(stream.name, "tactile", (360,), "uint16", "counts", 60)
    elif stream.kind == "keypoints":
        values = (values + rng.normal(scale=0.0005, size=values.shape)).astype(np.float32)
        stream = descriptor(stream.name, "keypoints", (25, 3), "float32", "m", 120)
    elif stream.kind == "pose":
        R = rotation_from_quaternion(values[:, 3:])
        R = R @ rotation_from_vector(rng.normal(scale=np.deg2rad(0.05), size=(len(values), 3)))
        moved = values[:, :3] + rng.normal(scale=0.0005, size=(len(values), 3))
        values = np.concatenate([moved, quaternion_from_rotation(R)], axis=1)
    latency_ns = LATENCY_MS[stream.kind] * 1e6
    calibration[f"{stream.name}_latency_ns"] = ((latency_ns,),)
    delay_ns = latency_ns + rng.exponential(0.8e6, len(t_ns))
    arrival_ns = np.maximum.accumulate(t_ns + np.rint(delay_ns).astype(np.int64)) + START_HOST_NS
    device_ns = np.rint(t_ns * (1 - 50e-6)).astype(np.int64) + int(rng.integers(10**12))
    sequence = np.arange(len(t_ns), dtype=np.int64)
    arrived = rng.random(len(t_ns)) >= 0.002
    columns = (arrival_ns, device_ns, sequence, values)
    return stream, tuple(column[arrived] for column in columns), calibration


def write_recording(store, streams, domain, *, recording_id="take", edit=None, leave_out=()):
    rng = np.random.default_rng(7)
    recorded, calibration = {}, {"K_head": K_HEAD}
    for name, (stream, t_ns, values) in streams.items():
        if name not in leave_out:
            raw, columns, more = as_recorded(stream, t_ns, values, rng)
            recorded[name] = (raw, list(columns))
            calibration |= more
    if edit is not None:
        edit(recorded, calibration)
    attributes = RecordingAttributes(
        recording_id=recording_id,
        task="stand-bottle",
        instruction="stand the bottle up",
        domain=domain,
        station="test",
        started_t_host_ns=START_HOST_NS,
        calibration=calibration,
    )
    with store.writer(kind="recording", attributes=attributes) as writer:
        for stream, (arrival_ns, device_ns, sequence, values) in recorded.values():
            writer.add_stream(stream)
            writer.append(
                stream.name,
                values=values,
                t_host_ns=arrival_ns,
                t_device_ns=device_ns,
                sequence=sequence,
            )


@pytest.mark.long
@pytest.mark.parametrize("domain", ["human", "robot"])
def test_errors_against_truth(tmp_path, domain, capsys):
    store = EpisodeStore(tmp_path)
    write_recording(store, write_truth(store, domain), domain)
    report = align_recording(store, "take", AlignmentOptions())
    episode, truth = store.open(report.episode_id), store.open(f"truth-{domain}")
    origin_ns = round(report.quality["origin_after_start_ns"])
    errors = compare_with_truth(episode, truth, origin_in_truth_ns=origin_ns)
    rows = [
        ("clock RMS, worst stream, ms", max(errors["clock_rms_ms"].values()), 1.0),
        ("latency left, worst stream, ms", max(map(abs, errors["latency_error_ms"].values())), 1.0),
        ("1 - taxel IoU", 1 - errors["taxel_iou"], 0.02),
        ("taxel MAE, kPa", errors["taxel_mae_kpa"], 0.05),
        ("fingertip, mm", errors["fingertip_error_mm"], 2.5 if domain == "human" else 0.5),
        ("wrist, mm", errors["wrist_error_mm"], 1.0),
        ("wrist, deg", errors["wrist_error_deg"], 0.1),
    ]
    with capsys.disabled():
        for name, error, bound in rows:
            sys.stdout.write(f"\n{domain:5s} {name:32s} {error:8.4f} | bound {bound}")
    assert all(error <= bound for _, error, bound in rows)
    assert report.num_steps in (80, 81)
    assert {clock.stream for clock in report.clocks} == set(store.recording("take").streams)
    dropped = {clock.stream: clock.num_dropped for clock in report.clocks}
    assert errors["num_dropped"] == dropped
    assert all(abs(clock.skew_ppm - 50) < 20 for clock in report.clocks)


def test_commanded_actions_are_relative_to_the_measured_start(tmp_path):
    store = EpisodeStore(tmp_path)
    streams = write_truth(store, "robot")
    write_recording(store, streams, "robot")
    report = align_recording(store, "take", AlignmentOptions())
    episode = store.open(report.episode_id)
    measured, commanded = (episode.read(n).values for n in ("action", "action_commanded"))
    np.testing.assert_allclose(measured[0, :9], [0, 0, 0, 1, 0, 0, 0, 1, 0], atol=1e-12)
    at_ns = episode.read("action").t_ref_ns + round(report.quality["origin_after_start_ns"])
    true = [poses(at_ns + 30_000_000, seed) for seed in (10, 11)]
    hands = [joints(RobotHand(s), at_ns + 30_000_000, i + 20) for i, s in enumerate(SIDES)]
    wanted = HandTrajectory(
        *map(transform_from_pose, true), *hands, transform_from_pose(poses(at_ns, 33))
    )
    expected = actions_from_poses(wanted, episode.attributes.anchor.to_poses())
    np.testing.assert_allclose(commanded[:, :3], expected[:, :3], atol=0.004)
    np.testing.assert_allclose(commanded[:, 18:58], expected[:, 18:58], atol=0.005)
    window = episode.window(0, action_kind="commanded")
    assert window.tactile_valid.all()


def test_aligning_again_writes_nothing(tmp_path):
    store = EpisodeStore(tmp_path)
    write_recording(store, truth_streams("robot"), "robot")
    first = align_recording(store, "take", AlignmentOptions())
    again = align_recording(store, "take", AlignmentOptions())
    other = align_recording(store, "take", AlignmentOptions(model_rate_hz=30))
    assert (first.created, again.created, other.created) == (True, False, True)
    assert first.model_copy(update={"created": False}) == again
    assert other.episode_id != first.episode_id
    assert store.open(first.episode_id).attributes.lineage[-1].id == "take"


def test_streams_that_may_be_absent_are_skipped_and_told(tmp_path):
    store = EpisodeStore(tmp_path)
    absent = ("tactile_left", "camera_head", "joints_commanded")
    write_recording(store, truth_streams("robot"), "robot", leave_out=absent)
    report = align_recording(store, "take", AlignmentOptions())
    assert {"tactile_left", "camera_head"} < set(report.absent)
    assert "action_commanded" not in report.streams


def test_missing_needed_streams_are_named(tmp_path):
    store = EpisodeStore(tmp_path)
    hands = ("wrist_left", "wrist_right", "keypoints_left", "keypoints_right")
    write_recording(store, truth_streams("human"), "human", leave_out=hands)
    with pytest.raises(InvalidInputError, match=r"wrist_left.*keypoints_right"):
        align_recording(store, "take", AlignmentOptions())
    with pytest.raises(NotFoundError):
        align_recording(store, "nothing", AlignmentOptions())
    assert store.list(kind="episode") == []


def test_missing_calibration_is_named(tmp_path):
    store, key = EpisodeStore(tmp_path), "tactile_left_tare_counts"
    streams = truth_streams("robot")
    write_recording(store, streams, "robot", edit=lambda _, calibration: calibration.pop(key))
    with pytest.raises(InvalidInputError, match=key):
        align_recording(store, "take", AlignmentOptions())


def cut_out(name, first, last):
    def edit(recorded, _):
        columns = recorded[name][1]
        keep = np.r_[0:first, last : len(columns[0])]
        columns[:] = [column[keep] for column in columns]

    return edit


def test_episode_is_the_longest_stretch_without_a_gap(tmp_path):
    store = EpisodeStore(tmp_path)
    streams = truth_streams("robot")
    write_recording(store, streams, "robot", edit=cut_out("wrist_left", 100, 130))
    report = align_recording(store, "take", AlignmentOptions())
    assert report.quality["wrist_left_num_gaps"] == 1
    assert report.num_steps == pytest.approx((DURATION_S - 1.3) * 15, abs=2)
    assert report.quality["num_steps_refused"] > 15
    write_recording(
        store, streams, "robot", recording_id="holes", edit=cut_out("wrist_left", 20, 500)
    )
    with pytest.raises(InvalidInputError, match=r"without a gap.*wrist_left"):
        align_recording(store, "holes", AlignmentOptions())


def test_stream_whose_clock_cannot_be_fitted_is_named(tmp_path):
    def stop_clock(recorded, _):
        recorded["head"][1][1][:] = 5

    store = EpisodeStore(tmp_path)
    write_recording(store, truth_streams("robot"), "robot", edit=stop_clock)
    with pytest.raises(ClockFitError, match="head"):
        align_recording(store, "take", AlignmentOptions())


def test_stream_without_stamps_is_dated_by_number_or_count(tmp_path):
    def forget(recorded, _):
        recorded["tactile_left"][1][1][:] = -1
        recorded["tactile_right"][1][1][:] = -1
        recorded["tactile_right"][1][2][:] = -1

    store = EpisodeStore(tmp_path)
    write_recording(store, write_truth(store, "robot"), "robot", edit=forget)
    report = align_recording(store, "take", AlignmentOptions())
    episode, truth = store.open(report.episode_id), store.open("truth-robot")
    origin_ns = round(report.quality["origin_after_start_ns"])
    errors = compare_with_truth(episode, truth, origin_in_truth_ns=origin_ns)
    assert errors["clock_rms_ms"]["tactile_left"] < 0.2
    assert errors["clock_rms_ms"]["tactile_right"] < 0.3
    skew = {clock.stream: clock.skew_ppm for clock in report.clocks}
    assert skew["tactile_right"] == pytest.approx(skew["tactile_left"], abs=50)
