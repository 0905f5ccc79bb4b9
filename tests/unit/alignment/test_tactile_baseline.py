"""Counts to kPa: exact inversion, dead cells, and records that do not fit."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.schemas import matrix_rows
from dextouch.tactile.layout import DEXTOUCH_V1, expand_taxels
from services.alignment.calibration.tactile_tare import (
    REASONS,
    TactileCalibration,
    taxel_faults,
    unusable_taxels,
)

RNG = np.random.default_rng(0)
TARE, GAIN = RNG.uniform(110, 130, 360), RNG.uniform(38, 42, 360)


def record(side, tare=TARE, gain=GAIN):
    return {
        f"tactile_{side}_tare_counts": [list(tare)],
        f"tactile_{side}_gain_counts_per_kpa": [list(gain)],
    }


def refused_taxels(glove, counts):
    return unusable_taxels(glove, taxel_faults(glove, [counts]))


@pytest.mark.parametrize("side", ["left", "right"])
def test_pressures_come_back(side):
    # Pressed harder and harder: readings without any order are no pressures.
    true_kpa = np.sort(RNG.uniform(0, 50, (40, 320)), axis=0)
    counts = np.rint(TARE + GAIN * expand_taxels(true_kpa, side=side)).astype(np.uint16)
    glove = TactileCalibration.from_record(record(side), side)
    np.testing.assert_allclose(glove.to_kpa(counts), true_kpa, atol=0.5 / 38 + 1e-4)
    assert not refused_taxels(glove, counts).any()


@pytest.mark.parametrize(("kept", "reason"), [(4000, "stuck"), (0, "dead")])
def test_taxels_that_stand_still_off_their_tare_are_silenced(kept, reason):
    cell = int(DEXTOUCH_V1.raw_indices(side="right")[7])
    counts = np.rint(np.broadcast_to(TARE + 200, (40, 360))).astype(np.uint16)
    counts[20:] += 1
    counts[:, cell] = kept
    glove = TactileCalibration.from_record(record("right"), "right")
    refused = refused_taxels(glove, counts)
    assert np.flatnonzero(refused).tolist() == [7]
    assert REASONS[refused[7]] == reason
    pressures = glove.to_kpa(counts, refused=refused)
    assert (pressures[:, 7] == 0).all()
    assert (np.delete(pressures, 7, axis=1) > 4).all()
    # A few samples say nothing.
    assert not refused_taxels(glove, counts[:20]).any()


def test_what_the_calibration_refuses_is_zero_and_its_gain_does_not_matter():
    cells = DEXTOUCH_V1.raw_indices(side="left")[[3, 200]]
    state, gain = np.zeros(360), GAIN.copy()
    state[cells], gain[cells] = (1, 6), 0.0
    counts = np.rint(np.broadcast_to(TARE + 800, (40, 360))).astype(np.uint16)
    counts[20:] += 1
    refusing = record("left", gain=gain) | {"tactile_left_taxel_state": [list(state)]}
    glove = TactileCalibration.from_record(refusing, "left")
    refused = refused_taxels(glove, counts)
    assert np.flatnonzero(glove.to_kpa(counts)[0] == 0).tolist() == [3, 200]
    assert [REASONS[refused[taxel]] for taxel in (3, 200)] == ["dead", "imprecise"]


def test_a_further_glove_of_a_hand_has_a_calibration_of_its_own():
    record = {
        f"{glove}_{name}": [[number] * 360]
        for glove, (tare, gain) in {
            "tactile_left": (1.0, 2.0),
            "tactile_left_forearm": (100.0, 50.0),
        }.items()
        for name, number in (("tare_counts", tare), ("gain_counts_per_kpa", gain))
    }
    glove = TactileCalibration.from_record(record, "left", stream="tactile_left_forearm")
    np.testing.assert_allclose(glove.to_kpa(np.full((1, 360), 400.0)), 6.0)
    with pytest.raises(InvalidInputError, match="'tactile_left_wrist_tare_counts' is missing"):
        TactileCalibration.from_record(record, "left", stream="tactile_left_wrist")


def test_another_map_selects_its_cells():
    cells = np.r_[np.arange(319)[::-1], -1]
    other = {
        "tactile_left_cells": matrix_rows(cells[None].astype(float)),
        "tactile_left_tare_counts": [[1.0] * 400],
        "tactile_left_gain_counts_per_kpa": [[2.0] * 400],
    }
    glove = TactileCalibration.from_record(other, "left", num_cells=400)
    counts = np.full((40, 400), np.nan, dtype=np.float32)
    counts[:, :319] = 1 + 2 * np.arange(319) + np.arange(40)[:, None] / 64
    # One reading of one cell is missing now and then, all of another.
    counts[5, 100], counts[3:9, 200] = np.nan, np.nan
    refused = refused_taxels(glove, counts)
    assert np.flatnonzero(refused).tolist() == [318 - 200, 319]
    assert {REASONS[code] for code in refused[refused > 0]} == {"absent"}
    pressures = glove.to_kpa(counts, refused=refused)
    np.testing.assert_allclose(pressures[0, :118], np.arange(318, 200, -1))
    assert np.flatnonzero(np.isnan(pressures).any(axis=1)).tolist() == [5]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cells": None}, "sends 400 numbers.*tactile_left_cells"),
        ({"cells": np.arange(319)}, r"tactile_left_cells.*\(1, 319\)"),
        ({"cells": np.arange(320) + 100}, "got 400 for taxel 300"),
        ({"cells": np.arange(320) - 2}, "got -2 for taxel 0"),
        ({"cells": np.arange(320) + 0.5}, "whole"),
        ({"cells": np.r_[np.arange(319), 7]}, r"cell 7 2 times \(taxels \[7, 319\]"),
        ({"cells": np.full(320, -1)}, "refuses all 320"),
        ({"tare_counts": np.ones(360)}, r"tare_counts.*\(1, 360\).*\(1, 400\)"),
        ({"taxel_state": np.full(400, 7)}, "got 7 for raw cell 0"),
        ({"taxel_state": np.ones(400)}, "refuses all 320"),
    ],
)
def test_maps_that_cannot_be_are_refused(change, words):
    rows = {
        "cells": np.arange(320),
        "tare_counts": np.ones(400),
        "gain_counts_per_kpa": np.ones(400),
    } | change
    other = {
        f"tactile_left_{name}": matrix_rows(np.array([row], dtype=float))
        for name, row in rows.items()
        if row is not None
    }
    with pytest.raises(InvalidInputError, match=words):
        TactileCalibration.from_record(other, "left", num_cells=400)


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
