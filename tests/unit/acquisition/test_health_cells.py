"""Gloves of other makers: cells are judged by their neighbours, without a tare."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from services.acquisition.devices.justfloat_glove import JustFloatGloveDecoder
from services.acquisition.devices.wuji_glove import WujiGloveDecoder
from services.acquisition.drivers.base import CellLayout
from services.acquisition.health.cells import CellCheck, cell_judge
from tests.unit.acquisition.health_blocks_made import SECOND_NS, block, codes, judged


class Sheet:
    """Cells of another maker's glove under a wave; the test changes single ones."""

    def __init__(self, judge, num_cells, *, full_scale=1.0):
        self.judge = judge
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
        return judged(self.judge, block(t_s, values), self.second * SECOND_NS)


class GridSheet(Sheet):
    absent = np.nan

    def __init__(self, used=None):
        super().__init__(CellCheck(CellLayout(1.0, (24, 32)), used), 768)


class BareSheet(Sheet):
    absent = 0.0

    def __init__(self, used=None):
        super().__init__(CellCheck(CellLayout(4095.0, None), used), 401, full_scale=4095.0)


@pytest.mark.parametrize("kind", [GridSheet, BareSheet])
def test_healthy_gloves_of_other_makers_raise_nothing(kind):
    sheet = kind()
    for second in range(20):
        assert sheet(pressed=second % 4 != 0).findings == []


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
    assert verdict.findings == []


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
    assert cell_judge(decoder, {}).used is None
    cells = np.arange(320.0) * 2 + 1
    cells[cells >= num_cells] = -1
    used = cell_judge(decoder, {"tactile_left_cells": (tuple(cells),)}).used
    assert np.flatnonzero(used).tolist() == cells[cells >= 0].tolist()
    for wrong in (num_cells, -2, 0.5):
        cells[7] = wrong
        with pytest.raises(InvalidInputError, match="for taxel 7, expected a whole number"):
            cell_judge(decoder, {"tactile_left_cells": (tuple(cells),)})


def test_a_hand_that_holds_still_on_a_glove_of_unknown_layout_is_no_fault():
    sheet = BareSheet()
    sheet()

    first = {}

    def held(values):
        first.setdefault("row", values[0, :300].copy())
        values[:, :300] = first["row"]

    for _ in range(8):
        assert sheet(held).findings == []
