"""One judge at a time, on made-up blocks: what is found, and what is not."""

from dataclasses import dataclass

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import Sample
from dextouch.tactile.layout import expand_taxels
from services.acquisition.clock import VirtualClock
from services.acquisition.counters import StreamCounters
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.glove_justfloat import JustFloatGloveDecoder
from services.acquisition.drivers.glove_wuji import WujiGloveDecoder
from services.acquisition.drivers.pose_tracker import PoseTrackerDecoder, pose_descriptor
from services.acquisition.drivers.tactile_glove import glove_descriptor
from services.acquisition.health_blocks import Block, SampleBlocks
from services.acquisition.health_camera import CameraJudge
from services.acquisition.health_cells import CellJudge, Cells, cells_of
from services.acquisition.health_clock import ClockJudge, CountingJudge
from services.acquisition.health_taxels import (
    GloveRecord,
    TaxelJudge,
    count_taxels,
    neighbour_share,
)
from services.acquisition.health_tracking import FiniteJudge, PoseJudge, TrackingJudge
from services.acquisition.mocks.ports import HidPort

SECOND_NS = 10**9
TARE, GAIN = 120.0, 40.0
NONE = np.empty(0, dtype=np.int64)


def block(t_s, values=None, *, t_device_ns=None, sequence=None):
    t_ns = np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    device_ns = t_ns + 77 if t_device_ns is None else np.asarray(t_device_ns, dtype=np.int64)
    numbers = np.arange(len(t_ns)) if sequence is None else np.asarray(sequence, dtype=np.int64)
    return Block(t_ns, device_ns, numbers.astype(np.int64), NONE, values)


def codes(verdict):
    return {finding.code: finding.level for finding in verdict.findings}


class Hand:
    """A left glove whose palm and tips are pressed by a bump that wanders over them."""

    def __init__(self, *, drift_counts=0.0, pressed=True, tare=TARE):
        full = np.full(320, 1.0)
        record = GloveRecord("left", full * tare, full * GAIN, full * 0.0)
        self.judge = TaxelJudge(glove_descriptor("left"), record)
        self.drift_counts, self.pressed = drift_counts, pressed
        self.tare = tare
        self.second = 0

    def __call__(self, change=None):
        t_s = self.second + np.arange(1, 61) / 60
        self.second += 1
        places = np.arange(320)
        wave = np.sin(2 * np.pi * t_s[:, None] + 0.4 * (places // 16) + 0.3 * (places % 16))
        kpa = 15 * (1 + wave) if self.pressed else 0 * wave
        taxels = np.rint(self.tare + self.drift_counts + GAIN * kpa)
        if change is not None:
            change(taxels)
        raw = expand_taxels(taxels, side="left").astype(np.uint16)
        return self.judge.judge(block(t_s, raw), round(self.second * 1e9))


def test_a_healthy_hand_raises_nothing_whether_it_touches_or_rests():
    for pressed in (True, False):
        hand = Hand(pressed=pressed)
        for _ in range(12):
            assert hand().findings == ()


@pytest.mark.parametrize(
    ("value", "code"),
    [(TARE, "taxels_dead"), (0, "taxels_dead"), (900, "taxels_stuck"), (65535, "taxels_saturated")],
)
def test_a_taxel_that_does_not_follow_its_neighbours_is_named(value, code):
    def change(taxels):
        taxels[:, 200] = value

    hand = Hand()
    hand()
    hand(change)
    assert codes(hand(change)) == {code: "WARN"}
    for _ in range(3):
        hand()
    assert hand().findings == ()


def test_five_per_cent_a_whole_pad_or_a_whole_line_is_an_error():
    def palm_cells(taxels):
        taxels[:, 80:320:16] = 0
        taxels[:, 85] = 0

    def tip(taxels):
        taxels[:, 16:32] = 0

    def line(taxels):
        taxels[:, 96:112] = 0

    for change, words in ((palm_cells, "16 taxels"), (tip, "fingertip"), (line, "16 taxels")):
        hand = Hand()
        verdicts = [hand(change) for _ in range(2)]
        (found,) = verdicts[-1].findings
        assert (found.code, found.level) == ("taxels_dead", "ERROR")
        assert words in found.message


def test_a_dead_scan_line_is_an_error_although_it_is_less_than_five_per_cent():
    # A raw column of the palm alone has 12 cells of 320; with the tips above it, 16.
    hand = Hand()
    column = [place for place in range(320) if hand.judge._indices[place] % 20 == 3]

    def change(taxels):
        taxels[:, column] = 0

    (found,) = [hand(change) for _ in range(2)][-1].findings
    assert found.level == "ERROR"
    assert "scan column 3" in found.message


def test_a_dead_taxel_stays_found_while_the_hand_rests():
    def change(taxels):
        taxels[:, 200] = TARE

    hand = Hand()
    for _ in range(2):
        hand(change)
    hand.pressed = False
    hand(change)
    assert codes(hand(change)) == {"taxels_dead": "WARN"}


@pytest.mark.parametrize(("drift_counts", "level"), [(2.0, None), (5.0, "WARN"), (-30.0, "ERROR")])
def test_the_zero_is_watched_at_rest(drift_counts, level):
    hand = Hand(drift_counts=drift_counts, pressed=False)
    for _ in range(3):
        verdict = hand()
    assert codes(verdict).get("baseline") == level
    assert verdict.figures["baseline_drift_ratio"] == pytest.approx(abs(drift_counts))
    hand.pressed = True
    hand()
    assert "baseline_drift_ratio" not in hand().figures


def test_neighbours_are_counted_on_their_own_pad():
    moved = np.zeros(320, dtype=np.bool_)
    moved[:16] = True
    share = neighbour_share(moved)
    assert np.all(share[:16] == 1.0)
    assert np.all(share[16:] == 0.0)
    moved[5] = False
    share = neighbour_share(moved)
    assert share[5] == 1.0
    assert share[0] == pytest.approx(2 / 3)


def test_a_takes_extremes_name_the_same_taxels(rng):
    low = np.full(360, 100, dtype=np.uint16)
    high = low + 800
    low[[228, 229, 250]] = high[[228, 229, 250]] = (0, 65535, 700)
    found = count_taxels(low, high, side="right")
    assert (found.dead, found.stuck, found.saturated) == (1, 1, 1)
    counters = StreamCounters()
    rows = rng.integers(100, 900, (50, 360)).astype(np.uint16)
    counters.add([Sample(index, row) for index, row in enumerate(rows)])
    np.testing.assert_array_equal(counters.extremes.low_counts, rows.min(axis=0))
    np.testing.assert_array_equal(counters.extremes.high_counts, rows.max(axis=0))
    assert counters.num_bytes == rows.nbytes


def test_encoded_images_count_their_bytes():
    counters = StreamCounters()
    values = np.empty(1, dtype=object)
    values[0] = b"x" * 321
    counters.add([Sample(0, values.reshape(()))])
    assert counters.num_bytes == 321
    assert counters.extremes is None


def test_jumps_are_seen_by_the_devices_clock():
    judge = PoseJudge(pose_descriptor("head"))
    t_s = np.arange(100) / 100
    poses = np.zeros((100, 7))
    poses[:, 0] = 0.3 * t_s
    assert judge.judge(block(t_s, poses), SECOND_NS).findings == ()
    poses[60:, 1] += 0.2
    verdict = judge.judge(block(1 + t_s, poses), 2 * SECOND_NS)
    assert codes(verdict) == {"jump": "WARN"}


@pytest.mark.parametrize(("tremble_m", "level"), [(2e-4, None), (2e-3, "WARN"), (8e-3, "ERROR")])
def test_trembling_is_judged_at_rest_only(rng, tremble_m, level):
    judge = PoseJudge(pose_descriptor("head"))
    t_s = np.arange(100) / 100
    poses = np.zeros((100, 7))
    poses[:, :3] = tremble_m / np.sqrt(3) * rng.standard_normal((100, 3))
    # Slower than 5 m/s from sample to sample, as a tracker's tremble is.
    verdict = judge.judge(block(t_s, poses), SECOND_NS)
    assert codes(verdict).get("pose_jitter") == level
    assert verdict.figures["stationary_jitter_meters"] == pytest.approx(tremble_m, rel=0.15)
    poses[:, 0] += t_s
    moving = PoseJudge(pose_descriptor("head")).judge(block(t_s, poses), SECOND_NS)
    assert "stationary_jitter_meters" not in moving.figures


def driver_of(decoder, kind=Driver):
    return kind("x", transport=HidPort("x").transport, decoder=decoder, clock=VirtualClock())


@pytest.mark.parametrize(
    ("kind", "count", "expected"),
    [
        ("occluded", 0, {}),
        ("occluded", 20, {"tracking": "WARN"}),
        ("occluded", 200, {"tracking": "ERROR"}),
        ("jumped", 1, {"jump": "WARN"}),
        ("stale", 100, {"tracking": "ERROR"}),
    ],
)
def test_what_a_trackers_decoder_leaves_out_is_judged(kind, count, expected):
    decoder = PoseTrackerDecoder("head")
    judge = TrackingJudge(driver_of(decoder))
    decoder.statistics.packets += 1000
    for sequence in range(count):
        decoder.tracking.leave_out(kind, state=2, sequence=sequence, t_host_ns=sequence)
    assert codes(judge.judge(block([]), SECOND_NS)) == expected


def test_values_that_are_no_numbers_are_counted_where_numbers_were():
    judge = FiniteJudge("tracking", "nodes are not seen")
    values = np.zeros((100, 25, 3), dtype=np.float32)
    values[:, 24] = np.nan
    assert judge.judge(block(np.arange(100) / 100, values), SECOND_NS).findings == ()
    values[:, :5] = np.nan
    verdict = judge.judge(block(1 + np.arange(100) / 100, values), 2 * SECOND_NS)
    assert codes(verdict) == {"tracking": "ERROR"}
    assert verdict.figures["missing_ratio"] == pytest.approx(5 / 24 / 2)


class Sheet:
    """Cells of another maker's glove under a wave; the test changes single ones."""

    def __init__(self, cells, num_cells, *, full_scale=1.0):
        self.judge = CellJudge(cells)
        self.num_cells, self.full_scale, self.second = num_cells, full_scale, 0
        self.rng = np.random.default_rng(2)

    def __call__(self, change=None, *, pressed=True):
        t_s = self.second + np.arange(1, 61) / 60
        self.second += 1
        phase = 0.02 * np.arange(self.num_cells)
        wave = 0.3 * (1 + np.sin(2 * np.pi * t_s[:, None] + phase)) * pressed
        noise = self.rng.normal(0.01, 0.001, (60, self.num_cells))
        values = (self.full_scale * np.clip(wave + noise, 0, 1)).astype(np.float32)
        values[:, 5:8] = self.absent
        if change is not None:
            change(values)
        return self.judge.judge(block(t_s, values), self.second * SECOND_NS)


class GridSheet(Sheet):
    absent = np.nan

    def __init__(self, used=None):
        super().__init__(Cells(1.0, (24, 32), used), 768)


class BareSheet(Sheet):
    absent = 0.0

    def __init__(self, used=None):
        super().__init__(Cells(4095.0, None, used), 401, full_scale=4095.0)


@pytest.mark.parametrize("kind", [GridSheet, BareSheet])
def test_healthy_gloves_of_other_makers_raise_nothing(kind):
    sheet = kind()
    for second in range(20):
        assert sheet(pressed=second % 4 != 0).findings == ()


@pytest.mark.parametrize(
    ("kind", "value", "code", "seconds"),
    [
        (GridSheet, 0.0, "taxels_dead", 1),
        (GridSheet, 0.5, "taxels_stuck", 1),
        (GridSheet, 1.0, "taxels_saturated", 2),
        (GridSheet, np.nan, "nan", 1),
        (BareSheet, 2000.0, "taxels_stuck", 6),
        (BareSheet, 4095.0, "taxels_saturated", 2),
    ],
)
def test_a_cell_out_of_order_is_found_without_a_tare(kind, value, code, seconds):
    sheet = kind()

    def change(values):
        values[:, 200] = value

    sheet()
    verdicts = [sheet(change) for _ in range(seconds)]
    assert codes(verdicts[-1]) == {code: "WARN"}
    for _ in range(2):
        verdict = sheet()
    assert verdict.findings == ()


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0, np.nan])
@pytest.mark.parametrize("is_used", [True, False])
def test_a_cell_that_no_taxel_uses_is_not_judged(value, is_used):
    used = np.zeros(768, dtype=np.bool_)
    used[100:420] = True
    used[200] = is_used
    sheet = GridSheet(used)

    def change(values):
        values[:, 200] = value

    sheet()
    verdicts = [sheet(change) for _ in range(3)]
    assert bool(verdicts[-1].findings) == is_used
    assert is_used or not any(verdict.suspicious for verdict in verdicts)


@pytest.mark.parametrize(
    "decoder",
    [
        WujiGloveDecoder("left"),
        JustFloatGloveDecoder("left", num_values=401, full_scale=4095.0, rate_hz=60.0),
    ],
)
def test_the_map_of_the_calibration_says_which_cells_are_used(decoder):
    num_cells = int(np.prod(decoder.descriptors[0].shape))
    assert cells_of(decoder, {}).used is None
    cells = np.arange(320.0) * 2 + 1
    cells[cells >= num_cells] = -1
    used = cells_of(decoder, {"tactile_left_cells": (tuple(cells),)}).used
    assert np.flatnonzero(used).tolist() == cells[cells >= 0].tolist()
    for wrong in (num_cells, -2, 0.5):
        cells[7] = wrong
        with pytest.raises(InvalidInputError, match="for taxel 7, expected a whole number"):
            cells_of(decoder, {"tactile_left_cells": (tuple(cells),)})


def test_a_hand_that_holds_still_on_a_glove_of_unknown_layout_is_no_fault():
    sheet = BareSheet()
    sheet()

    first = {}

    def held(values):
        first.setdefault("row", values[0, :300].copy())
        values[:, :300] = first["row"]

    for _ in range(8):
        assert sheet(held).findings == ()


@dataclass
class FakeQuality:
    frozen: bool = False
    blurred: bool = False
    gap: bool = False
    clipped_ratio: float = 0.0
    num_dropped: int = 0


class CheckedDriver(Driver):
    quality = FakeQuality()


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"frozen": True}, "image_frozen"),
        ({"blurred": True}, "image_blurred"),
        ({"gap": True}, "image_gap"),
        ({"clipped_ratio": 0.3}, "image_clipped"),
    ],
)
def test_bad_images_warn_and_are_an_error_after_a_second(change, code):
    driver = driver_of(PoseTrackerDecoder("head"), CheckedDriver)
    judge = CameraJudge(driver)
    assert judge.judge(block([]), 0).findings == ()
    driver.quality = FakeQuality(**change)
    seen = [codes(judge.judge(block([]), t * SECOND_NS)) for t in (1, 2)]
    assert seen == [{code: "WARN"}, {code: "ERROR"}]
    driver.quality = FakeQuality()
    assert judge.judge(block([]), 3 * SECOND_NS).findings == ()


def stamped(second, *, skew_ppm=0.0, step_ns=0, rng=None, delay_ms=0.0):
    t_s = second + np.arange(60) / 60
    numbers = second * 60 + np.arange(60)
    device_ns = np.rint(t_s * 1e9 * (1 - skew_ppm * 1e-6)).astype(np.int64) + 10**12 + step_ns
    delays_s = 0 if rng is None else rng.exponential(delay_ms * 1e-3, 60)
    return block(t_s + delays_s, t_device_ns=device_ns, sequence=numbers)


@pytest.mark.parametrize(("skew_ppm", "level"), [(50, None), (-400, "WARN"), (3000, "ERROR")])
def test_skew_is_found_within_two_seconds_and_later(skew_ppm, level, rng):
    judge = ClockJudge(glove_descriptor("left"))
    for second in range(15):
        arrived = stamped(second, skew_ppm=skew_ppm, rng=rng, delay_ms=0.5)
        verdict = judge.judge(arrived, (second + 1) * SECOND_NS)
        if second >= 1:
            assert codes(verdict).get("clock_skew") == level, second
    assert verdict.figures["clock_skew_ratio"] * 1e6 == pytest.approx(skew_ppm, abs=30)


def test_steps_are_counted_once_and_three_in_an_hour_are_an_error():
    judge = ClockJudge(glove_descriptor("left"))
    levels = []
    steps_ns = [0] * 4 + [-30_000_000] * 4 + [50_000_000] * 4 + [0] * 4
    for second, step_ns in enumerate(steps_ns):
        verdict = judge.judge(stamped(second, step_ns=step_ns), (second + 1) * SECOND_NS)
        levels.append(codes(verdict).get("clock_step"))
    assert levels == [None] * 4 + ["WARN"] * 8 + ["ERROR"] * 4
    assert judge.num_steps == 3
    quiet = judge.judge(block([]), 3700 * SECOND_NS)
    assert quiet.findings == ()


def late_ms(load, t_s):
    """How long a host that is busy in some way makes samples wait."""
    if load == "at the start":
        return 60.0 * (t_s < 1.3)
    if load == "two seconds and a half":
        return 40.0 * ((t_s > 6) & (t_s < 8.5))
    return np.clip(20.0 * (t_s - 4), 0.0, 50.0) * (t_s < 9)


@pytest.mark.parametrize("load", ["at the start", "two seconds and a half", "a growing queue"])
@pytest.mark.parametrize("has_sequence", [True, False])
def test_late_arrivals_of_a_busy_host_are_no_finding_of_the_devices_clock(load, has_sequence, rng):
    descriptor = glove_descriptor("left")
    capabilities = descriptor.capabilities.model_copy(update={"sequence": has_sequence})
    judge = ClockJudge(descriptor.model_copy(update={"capabilities": capabilities}))
    raised = set()
    for second in range(15):
        arrived = stamped(second, skew_ppm=50.0, rng=rng, delay_ms=0.5)
        t_s = second + np.arange(60) / 60
        t_host_ns = arrived.t_host_ns + np.rint(late_ms(load, t_s) * 1e6).astype(np.int64)
        t_host_ns = np.maximum.accumulate(t_host_ns)
        sequence = arrived.sequence if has_sequence else np.full(60, -1)
        late = Block(t_host_ns, arrived.t_device_ns, sequence, NONE)
        raised |= set(codes(judge.judge(late, (second + 1) * SECOND_NS)))
    assert raised <= {"clock_residual"}


def test_a_clock_that_wraps_is_no_step():
    capabilities = glove_descriptor("left").capabilities.model_copy(
        update={"sequence_bits": 16, "device_time_bits": 32, "tick_ns": 1000}
    )
    descriptor = glove_descriptor("left").model_copy(update={"capabilities": capabilities})
    judge = ClockJudge(descriptor)
    modulus_ns = 2**32 * 1000
    for second in range(6):
        arrived = stamped(second)
        device_ns = (arrived.t_device_ns - 10**12 + modulus_ns - 3 * SECOND_NS) % modulus_ns
        numbers = (arrived.sequence + 2**16 - 100) % 2**16
        wrapped = Block(arrived.t_host_ns, device_ns, numbers, NONE)
        assert judge.judge(wrapped, (second + 1) * SECOND_NS).findings == ()
    assert judge.num_steps == 0


def bare_descriptor(rate_hz=60):
    return StreamDescriptor(
        name="tactile_left",
        kind="tactile",
        shape=(400,),
        dtype="float32",
        unit="counts",
        nominal_rate_hz=rate_hz,
    )


def bare(numbers, rng, *, delay_ms, skew_ppm=0.0):
    t_s = numbers / 60 * (1 + skew_ppm * 1e-6) + rng.exponential(delay_ms * 1e-3, len(numbers))
    return block(np.maximum.accumulate(t_s))


@pytest.mark.parametrize(
    ("delay_ms", "level"), [(0.5, None), (2.0, "WARN"), (5.0, "ERROR")], ids=["0.5", "2", "5"]
)
def test_a_stream_without_stamps_is_judged_by_its_count(delay_ms, level, rng):
    judge = CountingJudge(bare_descriptor())
    for second in range(15):
        numbers = second * 60 + np.arange(60)
        kept = numbers[rng.random(60) > 0.005]
        arrived = bare(kept, rng, delay_ms=delay_ms, skew_ppm=300.0)
        verdict = judge.judge(arrived, (second + 1) * SECOND_NS)
    assert codes(verdict) == ({} if level is None else {"clock_residual": level})
    figures = verdict.figures
    if level is None:
        assert figures["clock_skew_ratio"] * 1e6 == pytest.approx(300, abs=60)
        assert figures["clock_residual_p95_seconds"] == pytest.approx(1.15e-3, abs=0.4e-3)
        assert figures["clock_resets"] == 0
    assert len(judge._undated) <= 10 * 6
    assert codes(judge.judge(block([]), 16 * SECOND_NS)) == {}


def test_a_restart_of_a_stream_without_stamps_is_counted_and_no_clock_is_guessed(rng):
    judge = CountingJudge(bare_descriptor())
    for second in range(20):
        # It pauses for half a second and goes on between two of its former moments.
        numbers = second * 60 + np.arange(60) + (30.5 if second >= 10 else 0.0)
        verdict = judge.judge(bare(numbers, rng, delay_ms=0.3), (second + 1) * SECOND_NS)
    assert verdict.figures["clock_resets"] == 1
    unsteady = CountingJudge(bare_descriptor())
    for second in range(5):
        arrived = block(second + np.sort(rng.random(40)))
        assert unsteady.judge(arrived, (second + 1) * SECOND_NS).figures == {}


def test_blocks_are_bounded_and_count_what_they_lose():
    descriptor = StreamDescriptor(
        name="head",
        kind="pose",
        shape=(7,),
        dtype="float64",
        unit="pose_m_wxyz",
        nominal_rate_hz=100,
    )
    blocks = SampleBlocks({"head": descriptor})
    for index in range(1000):
        blocks.add("head", [Sample(index, np.zeros(7))])
    assert blocks.dropped == 600
    taken = blocks.take("head")
    assert taken.t_host_ns.tolist() == list(range(600, 1000))
    assert len(blocks.take("head")) == 0
