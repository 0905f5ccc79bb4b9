"""Counts to kPa: exact inversion, dead cells, and records that do not fit."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.tactile.layout import expand_taxels, raw_indices
from services.alignment.calibration.tactile_baseline import TactileCalibration

RNG = np.random.default_rng(0)
TARE, GAIN = RNG.uniform(110, 130, 360), RNG.uniform(38, 42, 360)


def record(side, tare=TARE, gain=GAIN):
    return {
        f"tactile_{side}_tare_counts": [list(tare)],
        f"tactile_{side}_gain_counts_per_kpa": [list(gain)],
    }


@pytest.mark.parametrize("side", ["left", "right"])
def test_pressures_come_back(side):
    true_kpa = RNG.uniform(0, 50, (40, 320))
    counts = np.rint(TARE + GAIN * expand_taxels(true_kpa, side=side)).astype(np.uint16)
    glove = TactileCalibration.from_record(record(side), side)
    np.testing.assert_allclose(glove.to_kpa(counts), true_kpa, atol=0.5 / 38 + 1e-4)
    assert not glove.dead_taxels(counts).any()


def test_dead_taxels_are_found_and_silenced():
    cell = int(raw_indices(side="right")[7])
    counts = np.rint(np.broadcast_to(TARE, (40, 360))).astype(np.uint16)
    counts[:, cell] = 4000
    glove = TactileCalibration.from_record(record("right"), "right")
    dead = glove.dead_taxels(counts)
    assert np.flatnonzero(dead).tolist() == [7]
    assert glove.to_kpa(counts)[0, 7] > 50
    assert (glove.to_kpa(counts, dead=dead) < 0.1).all()


def test_below_the_tare_is_zero_not_negative():
    glove = TactileCalibration.from_record(record("left"), "left")
    assert (glove.to_kpa(np.zeros((1, 360), dtype=np.uint16)) == 0).all()


def test_bad_records_are_refused():
    with pytest.raises(InvalidInputError, match="tactile_left_tare_counts"):
        TactileCalibration.from_record(record("right"), "left")
    with pytest.raises(InvalidInputError, match="320"):
        TactileCalibration.from_record(record("left", tare=TARE[:320]), "left")
    with pytest.raises(InvalidInputError, match="gain"):
        TactileCalibration.from_record(record("left", gain=np.zeros(360)), "left")
    with pytest.raises(NonFiniteError):
        TactileCalibration.from_record(record("left", tare=np.full(360, np.nan)), "left")
    with pytest.raises(ShapeError):
        TactileCalibration.from_record(record("left"), "left").to_kpa(np.zeros((3, 320)))
