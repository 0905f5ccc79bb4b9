"""Faults of a whole glove, of a pad or of a row, made on the readings of mock gloves."""

import sys
import warnings

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.schemas import matrix_rows
from dextouch.streams import TaxelFaults, drifting_taxels, implausible_gain
from dextouch.tactile.layout import DEXTOUCH_V1
from services.acquisition.health.cells import TaxelCheck
from services.acquisition.health.glove_records import GloveRecord
from services.acquisition.mocks.gloves import GloveCalibration
from services.acquisition.mocks.pattern import pattern_streams
from services.alignment.calibration.tactile_tare import (
    REASONS,
    TactileCalibration,
    taxel_faults,
    unusable_taxels,
)
from tests.unit.acquisition.health_blocks_made import block, judged

SEEDS = range(20)
(PRESSURES,) = [s.values for s in pattern_streams() if s.descriptor.name == "tactile_left"]


def take(seed, *, noise=1.0, seconds=24):
    """A mock glove with the noise of a real one: each finger presses in turn, and the palm."""
    made = GloveCalibration.seeded("left", seed)
    kpa = np.tile(PRESSURES, (-(-seconds // 8), 1))[: 60 * seconds]
    clean = made.readings(kpa, side="left")
    noisy = clean + noise * np.random.default_rng(seed).standard_normal(clean.shape)
    calibration = TactileCalibration.from_record(made.matrices("left"), "left")
    return calibration, np.clip(np.rint(noisy), 0, 65535)


def found(calibration, counts):
    faults = taxel_faults(calibration, np.array_split(counts, 5))
    repeats = [one for one in faults.repeats() if not one.harmless]
    if any(one.whole for one in repeats):
        with pytest.raises(InvalidInputError, match="it is frozen"):
            unusable_taxels(calibration, faults)
        return {"frozen": range(len(counts))}
    try:
        states = unusable_taxels(calibration, faults)
    except InvalidInputError as error:
        return {error.details["fault"]: np.flatnonzero(faults.faults()[error.details["fault"]])}
    taxels = {REASONS[code]: np.flatnonzero(states == code) for code in set(states.tolist()) - {0}}
    return taxels | {one.cause: np.flatnonzero(one.samples) for one in repeats}


@pytest.mark.parametrize(
    "noise", [0.0, 0.3, *(pytest.param(n, marks=pytest.mark.long) for n in (0.6, 3.0))]
)
def test_mock_gloves_with_any_noise_have_no_fault(noise):
    for seed in SEEDS:
        assert found(*take(seed, noise=noise)) == {}
        calibration, counts = take(seed, noise=0.0)
        # Nothing is touched.
        rest = calibration.tare_counts.mean() + noise * np.random.default_rng(seed).standard_normal(
            counts.shape
        )
        rest = np.rint(rest + np.random.default_rng(9).uniform(-0.5, 0.5, 360))
        assert "frozen" not in found(calibration, rest)


@pytest.mark.parametrize("since", [400, 900], ids=["most", "a part"])
@pytest.mark.parametrize("dither", [(-1, 0, 1), (-1, 1), (-1, 0, 0, 1)], ids=str)
def test_a_frozen_glove_with_dither(since, dither):
    for seed in SEEDS:
        calibration, counts = take(seed, noise=[0.0, 1.0][seed % 2])
        rng = np.random.default_rng(seed)
        counts[since:] = counts[since] + rng.choice(dither, counts[since:].shape)
        assert abs(len(found(calibration, counts)["frozen"]) - (1440 - since)) <= 60
        # A glove that never moves may be one whose firmware clamps noise.
        (one,) = taxel_faults(calibration, [counts[since:]]).repeats()
        assert one.cause == "frozen"
        assert one.harmless


@pytest.mark.parametrize("touched_s", [0, 1, 10])
def test_a_glove_that_clamps_noise_and_is_hardly_touched_is_not_frozen(touched_s):
    for seed in SEEDS:
        calibration, clean = take(seed, noise=0.0)
        rng = np.random.default_rng(seed)
        dither = [rng.choice((-1, 0, 1), clean.shape), np.rint(rng.uniform(-1.2, 1.2, clean.shape))]
        counts = np.tile(clean[:1], (len(clean), 1)) + dither[seed % 2]
        pressed = rng.random(360) < [0.3, 0.9][seed // 2 % 2]
        at = slice(600, 600 + 60 * touched_s)
        wave = np.sin(np.arange(60 * touched_s) / 20) ** 2
        counts[at] += np.rint(800 * wave[:, None] * pressed)
        assert "frozen" not in found(calibration, counts)


@pytest.mark.parametrize("full_scale", [255, 1023, 4095])
@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_a_steady_grip_on_a_glove_of_few_levels_is_at_no_limit(full_scale, noise):
    layout = DEXTOUCH_V1.model_copy(update={"full_scale": float(full_scale), "range_kpa": 500.0})
    t_s = np.arange(1200)[:, None] / 60
    held = np.clip((t_s - 2) / 0.5, 0, 1) * np.clip((18 - t_s) / 0.5, 0, 1)
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        kpa = np.where(rng.random(320) < 0.35, rng.uniform(5, 80, 320), 0)
        tare = np.round(rng.uniform(5, 15, 320))
        gain = full_scale / 500 * rng.uniform(0.9, 1.1, 320)
        counts = tare + gain * kpa * held * (1 + 0.005 * np.sin(t_s))
        counts = np.rint(counts + noise * rng.standard_normal(counts.shape)).clip(0, full_scale)
        # Of a glove that sends N, by 0.05 N.
        for step, unit in ((1.0, 1.0), (0.05, 0.05 * 255 / full_scale)):
            faults = TaxelFaults(tare * unit, gain * unit, layout=layout, step=step / 10)
            faults.add(counts * unit)
            said = faults.faults()
            assert not (said["saturated"] | said["drifting"]).any()


@pytest.mark.parametrize(("kpa", "least"), [(4.0, 12), (10.0, 18), (25.0, 18)])
@pytest.mark.parametrize("bend", [0.0, 2.0])
def test_the_zero_of_a_pad_that_drifts(kpa, least, bend):
    hits = 0
    for seed in SEEDS:
        calibration, counts = take(seed)
        rng = np.random.default_rng(seed)
        pad = np.arange(16) + 16 * rng.integers(5)
        way = np.linspace(0, 1, len(counts))
        way = way if not bend else 1 - np.exp(-bend * way)
        counts[:, calibration.cells[pad]] += np.rint(40 * kpa * way)[:, None]
        hits += pad.tolist() == found(calibration, counts).get("drifting", pad[:0]).tolist()
    assert hits >= least, hits


def test_a_pad_that_is_touched_more_and_more_does_not_drift():
    rows, columns = np.indices((4, 4))
    bump = np.exp(-((rows - 1.5) ** 2 + (columns - 1.5) ** 2) / 3).ravel()
    lows = np.zeros((40, 320))
    lows[:, 16:32] = np.linspace(0, 20, 40)[:, None] * bump
    usable = np.ones(320, dtype=bool)
    assert not drifting_taxels(lows, usable).any()
    # Something soft is pressed harder and harder, by the whole hand or a finger, with a tremor.
    for taxels in (slice(0, 320), slice(16, 32)):
        for way in (np.linspace(0, 25, 80), np.linspace(25, 5, 80)):
            squeeze = np.zeros((80, 320))
            squeeze[:, taxels] = (way * (1 + 0.2 * np.sin(np.arange(80))))[:, None]
            assert not drifting_taxels(squeeze, usable).any()
            # It is kneaded, and never let go.
            squeeze[:, taxels] += 50 * (np.arange(80) % 8 == 4)[:, None]
            assert not drifting_taxels(squeeze, usable).any()
    # Pads of few taxels are often alike, let go or not.
    pads = [pad.model_dump() | {"rows": 2, "columns": 2} for pad in DEXTOUCH_V1.pads]
    cells = {side: tuple(range(24)) for side in ("left", "right")}
    few = DEXTOUCH_V1.model_copy(update={"pads": pads, "raw_cells": cells, "num_raw_cells": 24})
    taps = np.linspace(0, 25, 80)[:, None] * np.ones(24)
    taps[4::8, ::4] += 50
    assert not drifting_taxels(taps, usable[:24], few).any()
    lows[:, 16:32] = np.where(np.arange(40) < 20, 0, 20)[:, None]
    assert not drifting_taxels(lows, usable).any()


@pytest.mark.parametrize("top", [255, 900, 1023])
def test_readings_that_end_at_a_limit(top):
    for seed in SEEDS:
        calibration, counts = take(seed, noise=[0.0, 1.0][seed % 2])
        ends = (counts >= top).mean(axis=0)[calibration.cells]
        named = found(calibration, np.minimum(counts, top))["saturated"]
        assert set(np.flatnonzero(ends > 0.05)) <= set(named) <= set(np.flatnonzero(ends > 0.01))


ROWS, COLUMNS = np.mgrid[:15, :16] + 0.5
RADII = np.hypot(ROWS - 7.5, COLUMNS - 7.5)
HARD = {
    "two ridges": np.isin(COLUMNS, (6.5, 8.5)),
    "a fork": np.isin(COLUMNS, (4.5, 6.5, 8.5, 10.5)) & (ROWS > 3),
    "a ring round a taxel": (RADII > 0) & (RADII < 1.5),
    "a plate with a hole": (RADII > 1) & (RADII < 5),
    "the edge of a box": COLUMNS > 6,
    "a pen": abs(ROWS - COLUMNS) < 1.1,
}


def touched(seed, palms, deaf=()):
    """24 s in which a palm [15, 16] of kPa presses in each 2 s; deaf taxels show noise only."""
    calibration, _ = take(seed, seconds=1)
    press = np.sin(np.linspace(0, np.pi, 120))[:, None]
    kpa = np.zeros((120 * len(palms), 320))
    kpa[:, 80:] = np.concatenate([press * palm.ravel() for palm in palms])
    kpa[:, list(deaf)] = 0.0
    counts = np.full((len(kpa), 360), 500.0)
    counts[:, calibration.cells] = calibration.tare_counts + kpa * calibration.gain_counts_per_kpa
    return found(
        calibration, np.rint(counts + np.random.default_rng(seed).normal(size=counts.shape))
    )


@pytest.mark.parametrize("kind", HARD)
def test_gaps_of_hard_things_are_not_deaf(kind):
    """Gripped ever again at one place, or a taxel beside it."""
    for seed, reach in enumerate((0, 1)):
        rng = np.random.default_rng(seed)
        shifts, forces = rng.integers(-reach, reach + 1, (12, 2)), rng.uniform(10, 60, 12)
        palms = [
            force * np.roll(HARD[kind], shift, (0, 1))
            for force, shift in zip(forces, shifts, strict=True)
        ]
        assert "dead" not in touched(seed, palms)


@pytest.mark.parametrize(("kpa", "least"), [(8.0, 0), (15.0, 6), (40.0, 8)])
def test_deaf_taxels_among_soft_touches_are_found(kpa, least, capsys):
    deaf, num_found = (80 + 7 * 16 + 7, 80 + 7 * 16 + 8), 0
    for seed in range(8):
        spots = np.random.default_rng(seed).uniform((4, 4), (11, 12), (12, 2))
        palms = [kpa * np.exp(-((ROWS - r) ** 2 + (COLUMNS - c) ** 2) / 8) for r, c in spots]
        named = touched(seed, palms, deaf).get("dead", ())
        assert set(named) <= set(deaf)
        num_found += len(named) == 2
    with capsys.disabled():
        sys.stdout.write(f"\ntwo deaf taxels, touches of {kpa:g} kPa: found {num_found} of 8")
    assert num_found >= least


def three_grasps(deaf=(), *, is_whole_hand=True):
    """5 min with three soft grasps of 2 s by all taxels, or by the palm and a finger."""
    calibration, _ = take(0, seconds=1)
    kpa = np.zeros((300 * 60, 320))
    touching = slice(0, 320) if is_whole_hand else slice(64, 320)
    for first in (1800, 7200, 14_400):
        kpa[first : first + 120, touching] = 15 * np.sin(np.linspace(0, np.pi, 120))[:, None]
    kpa[:, list(deaf)] = 0.0
    counts = np.full((len(kpa), 360), 500.0)
    counts[:, calibration.cells] = calibration.tare_counts + kpa * calibration.gain_counts_per_kpa
    return found(calibration, np.rint(counts + np.random.default_rng(0).normal(size=counts.shape)))


@pytest.mark.parametrize("is_whole_hand", [True, False])
def test_taxels_that_are_seldom_touched_are_not_deaf(is_whole_hand):
    assert three_grasps(is_whole_hand=is_whole_hand) == {}


@pytest.mark.parametrize("is_whole_hand", [True, False])
def test_deaf_taxels_of_a_take_with_few_grasps_are_found(is_whole_hand):
    deaf = [80 + 7 * 16 + 7, 80 + 7 * 16 + 8]
    named = three_grasps(deaf, is_whole_hand=is_whole_hand)
    assert {cause: taxels.tolist() for cause, taxels in named.items()} == {"dead": deaf}


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (6.895, "counts/psi"), (1 / 6.895, "psi taken for kPa"), (100, "counts/bar"),
        (1e3, "counts/MPa"), (1 / 0.03, "counts/N"),
    ],
)  # fmt: skip
def test_gains_in_another_unit_are_named(factor, said):
    areas_m2 = DEXTOUCH_V1.areas_m2
    for seed in SEEDS:
        gain = GloveCalibration.seeded("left", seed).gain_counts_per_kpa
        assert implausible_gain(gain[:320], areas_m2) is None
        assert f"these look like {said}" in implausible_gain(gain[:320] * factor, areas_m2)
    # Gloves of a small range, and of taxels so large that a newton is about a kPa.
    small = DEXTOUCH_V1.model_copy(update={"range_kpa": 40.0, "full_scale": 4095.0})
    assert implausible_gain(np.full(320, 4095 / 40), areas_m2, small) is None
    assert implausible_gain(np.full(320, 4095 / 40), np.full(320, 9e-4), small) is None
    matrices = GloveCalibration.seeded("left", 0).matrices("left")
    name = "tactile_left_gain_counts_per_kpa"
    scaled = matrices | {name: matrix_rows(np.array(matrices[name]) * factor)}
    with pytest.raises(InvalidInputError, match=said) as refused:
        TactileCalibration.from_record(scaled, "left")
    assert refused.value.details["fault"] == "unit"


def live(change, *, gain=1.0, seconds=64):
    """What the health of a station says of the same readings."""
    calibration, counts = take(3, seconds=seconds)
    made = GloveCalibration.seeded("left", 3)
    cells = DEXTOUCH_V1.raw_indices("left")
    gains = made.gain_counts_per_kpa * gain
    check = TaxelCheck(GloveRecord(made.tare_counts, gains, np.zeros(360), cells))
    counts, said = change(calibration, counts), {}
    for second in range(len(counts) // 60):
        part = slice(60 * second, 60 * second + 60)
        t_s = np.arange(part.start, part.stop) / 60
        evaluation = judged(check, block(t_s, counts[part].astype(np.uint16)), round(1e9 * t_s[-1]))
        said |= {f.message: (f.code, f.level) for f in evaluation.findings if f.code != "baseline"}
    return said


def test_the_health_of_a_station_names_the_same():
    def dithered(_, counts):
        counts[1200:] = counts[1200] + np.random.default_rng(0).integers(-1, 2, counts[1200:].shape)
        return counts

    def drifting(calibration, counts):
        counts[:, calibration.cells[16:32]] += np.linspace(0, 400, len(counts))[:, None]
        return counts

    def same(_, counts):
        return counts

    assert live(same) == {}
    assert set(live(dithered).values()) == {("frozen", "ERROR")}
    # Before it has moved it may be at rest, and clamp its noise.
    resting = live(lambda _, counts: dithered(_, counts)[1200:], seconds=40)
    assert set(resting.values()) == {("frozen", "WARN")}
    assert any("16 taxels are drifting in index" in text for text in live(drifting))
    clipped = live(lambda _, counts: np.minimum(counts, 255), seconds=10)
    assert any("are saturated in" in text for text in clipped)
    assert any("counts/psi" in text for text in live(same, gain=6.895, seconds=10))


def test_taxels_that_say_nothing_are_no_fault():
    faults = TaxelFaults(np.full(320, 120.0), np.full(320, 40.0))
    faults.add(np.full((40, 320), np.nan))
    assert not any(faults.faults()[name].any() for name in ("saturated", "drifting"))


def test_a_glove_without_a_usable_taxel_is_not_judged():
    count = DEXTOUCH_V1.num_taxels
    none = np.zeros(count, dtype=bool)
    faults = TaxelFaults(np.zeros(count), np.full(count, 10.0), usable=none)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        faults.add(np.ones((400, count)))
        assert faults.num_samples == 0
        assert faults.repeats() == []
