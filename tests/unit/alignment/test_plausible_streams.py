"""Implausible values of a recording are left out of its episode, or refuse it, by their cause."""

from dataclasses import replace
from io import StringIO
from typing import get_args

import numpy as np
import pytest
from rich.console import Console
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from dextouch.episodes import EpisodeStore
from dextouch.errors import ClockFitError, InvalidInputError
from dextouch.geometry import pose_from_transform
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes, matrix_rows
from dextouch.streams import NO_SEQUENCE, ClockCapabilities, StreamDescriptor
from services.alignment.calibration.tactile_tare import (
    BELOW_TARE,
    DEAD,
    RANDOM,
    REASONS,
    STUCK,
    TactileCalibration,
    taxel_faults,
    unusable_taxels,
)
from services.alignment.command_line import WHY, report_line, report_page
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization.episode_builder import check_bodies, check_hand_traces
from services.alignment.synchronization.recorded_streams import date_stream
from services.alignment.synchronization.resampling import RefusedReason
from services.alignment.synchronization.stream_clock import time_stream
from tests.unit.alignment import recordings
from tests.unit.streams import moving_camera

SECONDS = 6


def moving(name, values, *, seed=0):
    """The hands of a person who reaches forward, and the head that looks at them, with noise."""
    rng = np.random.default_rng([seed, *name.encode()])
    count = len(values)
    if values.shape[1] == 40:
        return 0.2 + 0.02 * gaussian_filter1d(rng.standard_normal((count, 40)), 30, axis=0)
    waves = gaussian_filter1d(rng.standard_normal((count, 6)), 30, axis=0)
    waves /= waves.std()
    # Fingers along -z and the view along z are forward, along y of the world; palms look inward.
    forward = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    turn = Rotation.from_matrix(forward)
    if name == "head":
        turn = Rotation.from_euler("x", -120, degrees=True)
    turn = Rotation.from_rotvec(0.1 * waves[:, 3:]) * turn
    start_m = {"head": [0, 0, 0.4], "wrist_left": [-0.2, 0.4, 0], "wrist_right": [0.2, 0.4, 0]}
    poses = np.zeros((count, 7))
    poses[:, :3] = start_m[name] + 0.05 * waves[:, :3] + 5e-4 * rng.standard_normal((count, 3))
    poses[:, 3:] = turn.as_quat()[:, [3, 0, 1, 2]]
    return poses


def aligned(folder, fault=lambda name, values: values, **how):
    store = EpisodeStore(folder)
    recordings.write_recording(
        store,
        "take",
        seconds=SECONDS,
        edit=lambda name, values: fault(name, moving(name, values)),
        **how,
    )
    report = align_recording(store, "take", AlignmentOptions())
    return report, store.open(report.episode_id)


def only(stream, fault):
    def edit(name, values):
        if name == stream:
            fault(values)
        return values

    return edit


def causes(report):
    return [
        (part.reason, part.stream, round(part.start_s, 2), round(part.stop_s, 2))
        for part in report.refused_parts
        if part.reason not in {"late_start", "early_end"}
    ]


def test_a_plausible_take_loses_nothing(tmp_path):
    report, _ = aligned(tmp_path)
    assert report.quality["num_steps_refused"] == 0
    assert causes(report) == []


def test_a_pose_elsewhere_is_left_out_and_the_rest_is_joined(tmp_path):
    def jump(poses):
        poses[300, 0] += 0.5

    report, episode = aligned(tmp_path, only("wrist_left", jump))
    assert report.quality["num_steps_refused"] == 0
    assert report.quality["wrist_left_num_jump_samples"] == 1
    assert causes(report) == [("jump", "wrist_left", 2.99, 3.01)]
    poses = episode.read("wrist_left").values
    assert np.abs(poses[:, 0] + 0.2).max() < 0.3


def test_a_tracker_that_finds_itself_anew_parts_the_take(tmp_path):
    def move(poses):
        poses[200:, 1] += 0.5

    report, _ = aligned(tmp_path, only("wrist_left", move))
    assert report.quality["wrist_left_num_lasting_jumps"] == 1
    ((other, *_), (reason, stream, start_s, stop_s)) = causes(report)
    assert (reason, stream, other) == ("jump", "wrist_left", "shorter")
    assert start_s < 2.0 < stop_s
    # More than is ever bridged.
    assert 0.25 < stop_s - start_s < 0.5


def test_a_frozen_tracker_is_no_action(tmp_path):
    def freeze(poses):
        poses[100:300] = poses[100]

    report, episode = aligned(tmp_path, only("wrist_right", freeze))
    assert report.quality["wrist_right_num_frozen_samples"] == 199
    assert ("frozen", "wrist_right", 1.0, 3.0) in causes(report)
    # Of 15 steps a second, those of the three seconds after it.
    assert len(episode.read("action").values) in range(43, 47)


def test_a_robot_may_stand_still_exactly(tmp_path):
    def rest(poses):
        steps = np.interp(np.arange(600), [0, 200, 400, 599], [0, 200, 200, 399])
        moved = gaussian_filter1d(steps, 5)
        moved[220:380] = moved[220]
        smooth = gaussian_filter1d(poses, 10, axis=0)
        poses[:] = np.stack([np.interp(moved, np.arange(600), c) for c in smooth.T], axis=1)

    report, _ = aligned(tmp_path, only("wrist_right", rest))
    assert report.quality["num_steps_refused"] == 0


def test_a_tracker_that_repeats_each_pose_is_a_slower_one(tmp_path):
    def repeat(poses):
        poses[:] = poses[np.arange(len(poses)) // 3 * 3]

    report, episode = aligned(tmp_path, only("head", repeat))
    assert report.quality["num_steps_refused"] == 0
    assert report.quality["head_num_repeated_samples"] == 400
    assert len(episode.read("head").values) == 200


@pytest.mark.parametrize(
    ("stream", "factor", "said"),
    [
        ("wrist_left", 1000, "these look like millimetres"),
        ("head", 100, "these look like centimetres"),
        ("joints_measured", 180 / np.pi, "these look like degrees"),
    ],
)
def test_another_unit_is_refused_by_name(tmp_path, stream, factor, said):
    def scale(values):
        values[:, : 3 if stream != "joints_measured" else 40] *= factor

    with pytest.raises(InvalidInputError, match=f"{stream}.*{said}") as refused:
        aligned(tmp_path, only(stream, scale))
    assert refused.value.details["fault"] == "unit"
    assert refused.value.details["stream"] == stream


def dated(folder, domain, fault):
    """Dated streams of a take of that domain, and its quaternions as they are sent."""
    store = EpisodeStore(folder)
    recordings.write_recording(
        store, "take", seconds=SECONDS, edit=lambda name, values: fault(name, moving(name, values))
    )
    recording = store.recording("take")
    return {name: date_stream(recording, name) for name in recording.streams}, domain


def test_streams_with_names_like_those_of_hands_say_nothing_of_hands(tmp_path):
    store, names = EpisodeStore(tmp_path), ("keypoints_left", "keypoints_cup", "tactile_thumb")
    attributes = RecordingAttributes(
        recording_id="take", task="t", instruction="", domain="human", station="s"
    )
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, kind, shape in zip(
            names, ("keypoints", "keypoints", "scalar"), ((25, 3), (10, 3), ()), strict=True
        ):
            stream = StreamDescriptor(
                name=name, kind=kind, shape=shape, dtype="float64", unit="m", nominal_rate_hz=100
            )
            writer.add_stream(stream)
            t_ns = np.arange(600) * 10_000_000
            writer.append(name, values=np.zeros((600, *shape)), t_host_ns=t_ns)
    recording = store.recording("take")
    check_hand_traces({name: date_stream(recording, name) for name in names})


def swapped(poses):
    poses[:, 3:] = poses[:, [4, 5, 6, 3]]


@pytest.mark.parametrize(
    ("domain", "stream"),
    [("human", "head"), ("human", "wrist_left"), ("human", "wrist_right"), ("robot", "head")],
)
def test_another_order_of_quaternions_is_refused_by_name(tmp_path, domain, stream):
    with pytest.raises(InvalidInputError, match=f"{stream}.*x, y, z, w; expected w") as refused:
        check_bodies(*dated(tmp_path, domain, only(stream, swapped)))
    assert refused.value.details["fault"] == "quaternion_order"


def test_a_robot_that_a_camera_faces_and_bodies_without_rotation_are_accepted(tmp_path):
    check_bodies(*dated(tmp_path / "0", "robot", only("wrist_left", swapped)))

    def unturned(name, values):
        if values.shape[1] == 7:
            values[:, 3:] = [1, 0, 0, 0]
        return values

    for domain in ("human", "robot"):
        check_bodies(*dated(tmp_path / domain, domain, unturned))


def test_order_of_quaternions_of_all_trackers(tmp_path):
    def swap(name, values):
        if values.shape[1] == 7:
            values[:, 3:] = values[:, [4, 5, 6, 3]]
        return values

    with pytest.raises(InvalidInputError, match="head"):
        aligned(tmp_path, swap)


def glove():
    matrices = {
        "tactile_left_tare_counts": matrix_rows(np.full((1, 360), 500.0)),
        "tactile_left_gain_counts_per_kpa": matrix_rows(np.full((1, 360), 40.0)),
    }
    return matrices, TactileCalibration.from_record(matrices, "left")


def readings(calibration, *, noise=1.0, num=1200):
    """A noisy glove whose taxels 100 … 139 are pressed now and then."""
    rng = np.random.default_rng(0)
    counts = 500 + noise * rng.standard_normal((num, 360))
    press = 3000 * np.clip(np.sin(np.arange(num) / 60), 0, 1)
    counts[:, calibration.cells[100:140]] += press[:, None]
    return np.rint(counts)


def reasons_of(calibration, counts):
    # In pieces, as a recording is read.
    states = unusable_taxels(calibration, taxel_faults(calibration, np.array_split(counts, 7)))
    return {REASONS[code]: np.flatnonzero(states == code) for code in set(states.tolist()) - {0}}


def test_usable_taxels_remain_with_and_without_noise():
    _, calibration = glove()
    for noise in (0.0, 0.3, 1.0, 8.0):
        assert reasons_of(calibration, readings(calibration, noise=noise)) == {}


@pytest.mark.parametrize(
    ("value", "reason"),
    [(0, DEAD), (500, STUCK), (502, STUCK), (2000, STUCK)],
    ids=["zero", "tare", "near it", "loaded"],
)
@pytest.mark.parametrize("taxel", [10, 120], ids=["untouched", "pressed"])
def test_a_taxel_that_ends_within_the_take(value, reason, taxel):
    _, calibration = glove()
    counts = readings(calibration)
    counts[600:, calibration.cells[taxel]] = value
    found = reasons_of(calibration, counts)
    assert {name: taxels.tolist() for name, taxels in found.items()} == {REASONS[reason]: [taxel]}


def test_taxels_of_a_glove_without_noise_rest_as_long_as_they_like():
    _, calibration = glove()
    counts = readings(calibration, noise=0.0)
    counts[600:] = 500
    assert reasons_of(calibration, counts) == {}


def test_random_and_too_low_readings_of_some_taxels_and_of_all():
    _, calibration = glove()
    rng = np.random.default_rng(1)
    counts = readings(calibration)
    counts[:, calibration.cells[:20]] = rng.integers(0, 65536, (len(counts), 20))
    counts[:, calibration.cells[30:34]] -= 200
    found = reasons_of(calibration, counts)
    assert found[REASONS[RANDOM]].tolist() == list(range(20))
    assert found[REASONS[BELOW_TARE]].tolist() == list(range(30, 34))
    for bad, fault in (
        (rng.integers(0, 65536, counts.shape).astype(float), "random"),
        (counts - 300, "below_tare"),
        (0 * counts, "dead"),
        (0 * counts + 900, "stuck"),
    ):
        with pytest.raises(InvalidInputError, match="left glove: readings of") as refused:
            unusable_taxels(calibration, taxel_faults(calibration, [bad]))
        assert refused.value.details["fault"] == fault


def test_cells_that_copy_others_loose_and_deaf_ones_are_named():
    _, calibration = glove()
    cells, rng = calibration.cells, np.random.default_rng(2)
    counts = readings(calibration)
    # All that is around these moves; they show their noise only.
    counts[:, cells[80:320]] += 2000 * np.clip(np.sin(np.arange(1200) / 40), 0, 1)[:, None]
    counts[:, cells[200:204]] = np.rint(500 + rng.standard_normal((1200, 4)))
    counts[:, cells[10]] = counts[:, cells[60]]
    counts[:, cells[20]] *= rng.random(1200) < 0.8
    found = {name: taxels.tolist() for name, taxels in reasons_of(calibration, counts).items()}
    assert found == {"dead": [200, 201, 202, 203], "copied": [10, 60], REASONS[RANDOM]: [20]}


def test_samples_that_a_glove_repeats_and_a_zero_that_has_moved():
    _, calibration = glove()
    counts = readings(calibration, num=1800)
    assert taxel_faults(calibration, [counts]).repeats() == []
    frozen = counts.copy()
    frozen[700:900] = frozen[700]
    (one,) = taxel_faults(calibration, np.array_split(frozen, 7)).repeats()
    assert (one.cause, np.flatnonzero(one.samples).tolist()) == ("frozen", list(range(701, 900)))
    looped = counts.copy()
    looped[700:900] = looped[700 + np.arange(200) % 3]
    (one,) = taxel_faults(calibration, np.array_split(looped, 7)).repeats()
    assert (one.cause, one.samples.sum()) == ("frozen", 197)
    (one,) = taxel_faults(calibration, [counts[np.arange(1800) // 3 * 3]]).repeats()
    assert (one.cause, one.factor) == ("repeated", 3)
    # A glove without noise may rest.
    assert taxel_faults(calibration, [np.rint(0 * counts + 500)]).repeats() == []
    moved = taxel_faults(calibration, [counts + np.linspace(0, 400, 1800)[:, None]])
    assert moved.zero_kpa.max() == pytest.approx(8.3, abs=0.3)
    with pytest.raises(InvalidInputError, match="tare the glove again") as refused:
        unusable_taxels(calibration, taxel_faults(calibration, [65535 - counts]))
    assert refused.value.details["fault"] == "baseline"


def of_gain(factor):
    matrices, calibration = glove()
    gain = np.array(matrices["tactile_left_gain_counts_per_kpa"]) * factor
    matrices["tactile_left_gain_counts_per_kpa"] = matrix_rows(gain)
    counts = [readings(calibration)]
    return TactileCalibration.from_record(matrices, "left"), counts


def test_gains_of_another_unit_are_refused_by_name():
    with pytest.raises(InvalidInputError, match="these look like counts/MPa"):
        of_gain(1e3)
    large, counts = of_gain(1e-3)
    with pytest.raises(InvalidInputError, match="its gain looks like counts/Pa"):
        unusable_taxels(large, taxel_faults(large, counts))
    # Gloves of 8 bits have small gains.
    few, (counts,) = of_gain(1 / 80)
    eight = np.rint(500 + (counts - 500) / 80)
    assert not unusable_taxels(few, taxel_faults(few, [eight])).any()


def test_readings_that_are_missing_hide_no_change():
    _, calibration = glove()
    counts = readings(calibration)
    # In one of the pieces it changes, and misses a reading as well.
    cell = calibration.cells[50]
    counts[:, cell] = 900
    counts[:50, cell] = 900 + np.arange(50)
    counts[20, cell] = np.nan
    assert reasons_of(calibration, counts) == {}


def test_faulty_taxels_without_a_gain_leave_the_unit_of_the_others_checked():
    matrices, _ = glove()
    gain = np.array(matrices["tactile_left_gain_counts_per_kpa"]) * 1e3
    state = np.zeros((1, 360))
    gain[0, :4], state[0, :4] = 0.0, 1
    faulty = {
        "tactile_left_gain_counts_per_kpa": matrix_rows(gain),
        "tactile_left_taxel_state": matrix_rows(state),
    }
    with pytest.raises(InvalidInputError, match="these look like counts/MPa"):
        TactileCalibration.from_record(matrices | faulty, "left")


def test_taxels_that_are_random_from_some_moment_on():
    _, calibration = glove()
    counts = readings(calibration, num=3000)
    last = counts[2300:]
    last[:, calibration.cells[:20]] = np.random.default_rng(1).integers(0, 65536, (700, 20))
    assert reasons_of(calibration, counts)[REASONS[RANDOM]].tolist() == list(range(20))


def test_a_press_at_full_scale_ends_there_and_a_frozen_glove_condemns_no_taxel():
    _, calibration = glove()
    counts = readings(calibration)
    counts[600:, calibration.cells[100:140]] = 65535
    found = reasons_of(calibration, counts)
    assert {name: of.tolist() for name, of in found.items()} == {"saturated": [*range(100, 140)]}
    counts = readings(calibration)
    counts[700:] = counts[700]
    assert reasons_of(calibration, counts) == {}


def test_taps_and_vibrations_are_not_random():
    _, calibration = glove()
    rng = np.random.default_rng(3)
    counts = readings(calibration, num=600)
    taps = np.where(rng.random(600) < 0.15, 4000, 0)
    counts[:, calibration.cells[:40]] += taps[:, None]
    assert reasons_of(calibration, counts) == {}
    counts = readings(calibration, num=600)
    vibrates = 2000 + 1500 * np.sin(2 * np.pi * 0.47 * np.arange(600))
    counts[:, calibration.cells[:200]] += vibrates[:, None]
    assert reasons_of(calibration, counts) == {}


@pytest.mark.parametrize(
    ("bits", "tick_ns"), [(16, 1_000_000), (16, 100_000), (24, 1_000), (16, 1_000)]
)
@pytest.mark.parametrize("seconds", [20, 63.7, 300])
def test_counters_that_wrap_are_no_other_unit(bits, tick_ns, seconds):
    true_s = np.arange(round(60 * seconds)) / 60
    counts = np.floor(true_s * 1e9 / tick_ns).astype(np.int64) % 2**bits
    batch, descriptor = recordings.stamped(true_s, counts * tick_ns, 60)
    clock = ClockCapabilities(
        sequence=True, device_time=True, tick_ns=tick_ns, device_time_bits=bits
    )
    timed = time_stream(batch, descriptor.model_copy(update={"capabilities": clock}))
    assert timed.report.num_steps == 0
    error_s = timed.t_host_ns / 1e9 - (recordings.START_NS / 1e9 + true_s)
    assert np.abs(error_s - np.median(error_s)).max() < 1e-3


@pytest.mark.parametrize("at", [0.3, 0.5, 0.7])
def test_a_clock_that_is_set_is_no_other_unit(at):
    true_s = np.arange(1000) / 100
    stamps_ns = np.rint(true_s * 1e9).astype(np.int64)
    stamps_ns[round(1000 * at) :] += 3600 * 10**9
    timed = time_stream(*recordings.stamped(true_s, stamps_ns, 100))
    assert timed.report.num_steps == 1


def test_stamps_of_a_polled_device_are_kept():
    # Samples are taken every 16 ms or so, at the polls every 8 ms.
    true_s = np.ceil(np.arange(1200) / 60 / 0.008) * 0.008
    timed = time_stream(*recordings.stamped(true_s, np.rint(true_s * 1e9).astype(np.int64), 60))
    assert timed.report.method == "device"
    error_s = timed.t_host_ns / 1e9 - (recordings.START_NS / 1e9 + true_s)
    assert np.abs(error_s - np.median(error_s)).max() < 1e-3


@pytest.mark.parametrize("hours", [24, 100, 400])
@pytest.mark.parametrize("rate_hz", [60, 120])
def test_stamps_in_floats_of_seconds_are_replaced_by_sequence_numbers(rate_hz, hours):
    sequence = np.arange(60 * rate_hz)
    true_s = sequence / rate_hz
    stamps_ns = np.rint(np.float32(true_s + 3600 * hours).astype(float) * 1e9).astype(np.int64)
    batch, descriptor = recordings.stamped(true_s, stamps_ns, rate_hz)
    timed = time_stream(batch, descriptor)
    assert timed.report.method == "sequence"
    assert len(timed.kept) == len(sequence)
    error_s = timed.t_host_ns / 1e9 - (recordings.START_NS / 1e9 + true_s)
    assert np.abs(error_s - np.median(error_s)).max() < 2e-4


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9], ids=["us", "ms", "s"])
def test_stamps_of_another_unit_are_refused_by_name(unit):
    true_s = np.arange(6000) / 100
    stamps_ns = np.rint(true_s * 1e9 / unit).astype(np.int64)
    batch, descriptor = recordings.stamped(true_s, stamps_ns, 100)
    with pytest.raises(ClockFitError, match="taken for nanoseconds") as refused:
        time_stream(batch, descriptor)
    assert refused.value.details["fault"] == "unit"


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e-3])
def test_a_unit_that_changes_within_a_take(unit):
    true_s = np.arange(3000) / 100
    stamps_ns = np.rint(np.where(true_s < 10, true_s, true_s / unit) * 1e9).astype(np.int64)
    batch, descriptor = recordings.stamped(true_s, stamps_ns, 100)
    timed = time_stream(batch, descriptor)
    assert (timed.report.method, len(timed.kept)) == ("sequence", 3000)
    error_s = timed.t_host_ns / 1e9 - (recordings.START_NS / 1e9 + true_s)
    assert np.abs(error_s - np.median(error_s)).max() < 1e-3
    unnumbered = replace(batch, sequence=np.full(3000, NO_SEQUENCE))
    with pytest.raises(ClockFitError, match="expected 1e") as refused:
        time_stream(unnumbered, descriptor)
    assert refused.value.details["fault"] == "unit"


def test_the_command_says_what_it_left_out(tmp_path):
    def fault(name, values):
        if name == "wrist_left":
            values[300, 0] += 0.5
        if name == "head":
            values[100:300] = values[100]
        return values

    lost = (("wrist_right", 400, 408),)
    store = EpisodeStore(tmp_path)

    def edit(name, values):
        arrived = np.delete(np.arange(SECONDS * 100), range(400, 408))
        whole = fault(name, moving(name, np.zeros((SECONDS * 100, values.shape[1]))))
        return whole[arrived] if name == "wrist_right" else whole

    recordings.write_recording(store, "take", seconds=SECONDS, edit=edit, lost=lost)
    report = align_recording(store, "take", AlignmentOptions())
    line = report_line(report)
    assert "head: 199 frozen samples" in line
    assert "wrist_left: 1 samples elsewhere" in line
    assert "2 of 46 steps interpolated across gaps" in line
    console = Console(width=120)
    with console.capture() as page:
        console.print(report_page(report))
    assert "head: frozen samples" in page.get()
    assert set(WHY) == set(get_args(RefusedReason))


def seen_by_head(folder, change, *, late_s=0.0):
    """A take whose head turns, with JPEG images of its camera, changed."""
    store = EpisodeStore(folder)
    t_ns, pictures = moving_camera.images(0, SECONDS, late_s, 60)
    Ts = moving_camera.poses(0, SECONDS, 60)[1]

    def turning(name, values):
        if name == "head":
            values[:] = pose_from_transform(Ts[: len(values)])
        return values

    recordings.write_recording(
        store,
        "take",
        seconds=SECONDS,
        edit=turning,
        camera=(moving_camera.K, t_ns, [encode_jpeg(image) for image in change(pictures)]),
    )
    report = align_recording(store, "take", AlignmentOptions())
    return report, store.open(report.episode_id)


def test_images_that_no_camera_takes_are_left_out_counted_and_placed(tmp_path):
    def fault(pictures):
        pictures[[40, 41, 70]] = 3
        pictures[100, 60:] = 128
        return pictures

    report, episode = seen_by_head(tmp_path / "faulty", fault)
    quality = report.quality
    assert quality["camera_head_num_black_samples"] == 3
    assert quality["camera_head_first_black_s"] == pytest.approx(40 / 30, abs=0.01)
    assert quality["camera_head_num_torn_samples"] == 1
    assert min(image.mean() for image in episode.images("camera_head")) > 30
    console = Console(width=200, record=True, file=StringIO())
    console.print(report_page(report))
    assert "camera_head: 3 black images between others" in console.export_text()
    report, _ = seen_by_head(tmp_path / "right", lambda pictures: pictures)
    assert [name for name in report.quality if "first" in name or "_looks_" in name] == []
    assert report.quality["camera_head_still_share"] == 0


def said(report):
    console = Console(width=200, record=True, file=StringIO())
    console.print(report_page(report))
    return console.export_text()


def test_mirrored_images_are_said_and_late_ones_are_not_taken_for_them(tmp_path):
    report, _ = seen_by_head(tmp_path / "mirrored", lambda pictures: pictures[:, :, ::-1])
    assert "camera_head: looks mirrored left for right" in said(report)
    report, _ = seen_by_head(tmp_path / "late", lambda pictures: pictures, late_s=0.2)
    assert "looks" not in said(report)
