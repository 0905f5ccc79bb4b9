"""Stress of tactile calibration: gloves with known tare and gain, silent, saturated or broken."""

import numpy as np

from benchmarks.stress.cells import Check, StageCells
from dextouch.errors import NonFiniteError
from dextouch.tactile import DEXTOUCH_V1
from dextouch.tactile.layout import NUM_TAXELS
from services.alignment.calibration.tactile_gain import TaxelPress, fit_gain
from services.alignment.calibration.tactile_tare import (
    SATURATED,
    STATES,
    TactileCalibration,
    TaxelTare,
    measure_tare,
    taxel_faults,
    unusable_taxels,
)

STAGE = StageCells("tactile-calibration")
_TARE, _GAIN, _FULL = 500.0, 100.0, 65_535.0
_CELLS = DEXTOUCH_V1.raw_indices(side="left")


@STAGE.cell("clock", "a rest take of 59 readings, and one that jumps half-way")
def _clock(check: Check) -> None:
    rest = _take(0.0)
    check.refused("59 readings", measure_tare, rest[:59], side="left")
    jumped = rest.copy()
    jumped[300:] += 50.0
    check.refused("a zero that jumps", measure_tare, jumped, side="left")


@STAGE.cell(
    "non_finite", "NaN and infinity in takes, gains and pressures; readings that are absent"
)
def _non_finite(check: Check) -> None:
    for bad in (np.nan, np.inf):
        rest = _take(0.0)
        rest[10, 20] = bad
        check.refused(f"{bad} at rest", measure_tare, rest, kind=NonFiniteError, side="left")
        check.refused(f"{bad} kPa", _press, bad, _take(10.0), kind=NonFiniteError)
        gains = np.full(360, _GAIN)
        gains[7] = bad
        check.refused(f"gain {bad}", _calibration, gains, kind=NonFiniteError)
    check.refused("gain 0", _calibration, np.zeros(360))
    counts = _take(10.0)
    counts[:, _CELLS[3]] = np.nan
    found = _calibration(np.full(360, _GAIN))
    refused = unusable_taxels(found, taxel_faults(found, [counts]))
    kpa = found.to_kpa(counts, refused=refused)
    check.true("an absent taxel is named and zero", refused[3] > 0 and not kpa[:, 3].any())
    check.finite("pressures", kpa)
    forces_n = DEXTOUCH_V1.pad_forces_n
    check.refused("NaN to forces", forces_n, np.full((1, 320), np.nan), kind=NonFiniteError)
    tiny = forces_n(np.full((1, 320), 5e-324))
    check.at_most("force of 5e-324 kPa", tiny.max(), 0.0, "N")


@STAGE.cell("touch", "counts of 0 and 65535; a taxel at the stop; all of them; nothing pressed")
def _touch(check: Check) -> None:
    found = _calibration(np.full(360, _GAIN))
    zero = found.to_kpa(np.zeros((5, 360), dtype=np.uint16))
    check.at_most("pressure of 0 counts", zero.max(), 0.0, "kPa")
    full = found.to_kpa(np.full((5, 360), 65_535, dtype=np.uint16))
    check.at_most("65535 counts off", np.abs(full - (_FULL - _TARE) / _GAIN).max(), 1e-4, "kPa")
    tare = _tare()
    counts = _take(20.0)
    counts[:, _CELLS[5]] = _FULL
    gain = fit_gain(tare, [_press(20.0, counts)])
    check.true(
        "a taxel at the stop is refused by name",
        STATES[gain.state[5]] == STATES[SATURATED] and gain.gain_counts_per_kpa[5] == 0,
    )
    others = np.delete(gain.gain_counts_per_kpa, 5)
    check.at_most("gain of the others off", np.abs(others / _GAIN - 1).max(), 0.01)
    every = np.full((600, 360), _FULL)
    check.refused("all at the stop", lambda: fit_gain(tare, [_press(20.0, every)]))
    check.refused("nothing moved", lambda: fit_gain(tare, [_press(20.0, _take(0.0))]))
    check.refused(
        "press and rest exchanged",
        lambda: fit_gain(measure_tare(_take(4.0), side="left"), [_press(20.0, _take(0.0))]),
    )


@STAGE.cell("ends", "pressures of 0 and 1e-12 kPa; no press; 60 readings, the fewest")
def _ends(check: Check) -> None:
    check.refused("0 kPa", _press, 0.0, _take(0.0))
    check.refused("no press", lambda: fit_gain(_tare(), []))
    check.refused("1e-12 kPa", lambda: fit_gain(_tare(), [_press(1e-12, _take(0.0))]))
    short = measure_tare(_take(0.0)[:60], side="left")
    zero = np.abs(short.level.mean_counts - _TARE)
    check.at_most("zero from 60 readings off", zero.max(), 2.0, "counts")


@STAGE.cell("precision", "counts as uint16, float32 and float16 (whole numbers to 2048)")
def _precision(check: Check) -> None:
    found = _calibration(np.full(360, _GAIN))
    counts = np.rint(_take(10.0))
    exact = found.to_kpa(counts)
    for kind in ("uint16", "float32", "float16"):
        check.equal(f"{kind}: pressures", found.to_kpa(counts.astype(kind)), exact)
    check.true("pressures are float32", exact.dtype == np.float32)


@STAGE.cell("long_run", "1008 steps of 4 readings, in pieces of 16 steps and as one take")
def _long_run(check: Check) -> None:
    found = _calibration(np.full(360, _GAIN))
    rng = np.random.default_rng(1)
    counts = np.rint(_TARE + _GAIN * rng.uniform(0, 40, (4032, 360)))
    pieces = [found.to_kpa(counts[k : k + 64]) for k in range(0, 4032, 64)]
    check.equal("pressures", np.concatenate(pieces), found.to_kpa(counts))


@STAGE.cell("batch", "one reading and 600; one press and the same press twice")
def _batch(check: Check) -> None:
    found = _calibration(np.full(360, _GAIN))
    counts = _take(10.0)
    alone = np.concatenate([found.to_kpa(counts[k : k + 1]) for k in range(50)])
    check.equal("pressures", alone, found.to_kpa(counts)[:50])
    tare, press = _tare(), _press(20.0, _take(20.0))
    once, twice = fit_gain(tare, [press]), fit_gain(tare, [press, press])
    change = np.abs(once.gain_counts_per_kpa - twice.gain_counts_per_kpa).max()
    check.at_most("gain changes", change, 0.01 * _GAIN, "counts/kPa")


STAGE.does_not_apply(
    rotations="no rotations",
    one_axis="no motion",
    device="numpy arrays live in the host's memory",
)


def _take(pressure_kpa: float, num: int = 600) -> np.ndarray:
    """Readings of a glove with zero 500 counts, gain 100 counts/kPa and noise of 2 counts."""
    noise = np.random.default_rng(round(pressure_kpa * 1000)).normal(scale=2.0, size=(num, 360))
    return np.asarray(np.rint(_TARE + _GAIN * pressure_kpa + noise))


def _tare() -> TaxelTare:
    return measure_tare(_take(0.0), side="left")


def _press(pressure_kpa: float, counts: np.ndarray) -> TaxelPress:
    return TaxelPress(pressure_kpa, 0.01, counts, np.ones(NUM_TAXELS, dtype=np.bool_))


def _calibration(gain_counts_per_kpa: np.ndarray) -> TactileCalibration:
    record = {
        "tactile_left_tare_counts": np.full((1, 360), _TARE).tolist(),
        "tactile_left_gain_counts_per_kpa": gain_counts_per_kpa[None].tolist(),
    }
    return TactileCalibration.from_record(record, "left")
