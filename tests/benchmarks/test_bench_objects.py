"""`python -m benchmarks objects`: one take of a task by both designs of markers, and by clicks."""

from contextlib import nullcontext

import numpy as np
import pytest

from benchmarks import objects
from benchmarks.command import stage_parser
from dextouch.errors import InvalidInputError


def options(*arguments):
    parser = stage_parser("objects")
    objects.add_options(parser)
    return parser.parse_args(list(arguments))


def bar(*_):
    return nullcontext(lambda _: None)


def test_a_quick_run_compares_both_designs(tmp_path):
    chosen = options("--quick", "--tasks", "stand_bottle")
    report = objects.measure(chosen, tmp_path, bar)
    table, clicked, touched = report.tables
    assert [row[1] for row in table.rows] == [objects.OURS, objects.USUAL] * len(objects.LOOKS)
    sharp = [
        report.data[f"{objects.SIDES_PX[0]} px, sharp, {design}"] for design in objects.DESIGNS
    ]
    ours, usual = (one["off_mm"] for one in sharp)
    assert ours < 2.5 < usual
    assert len(clicked.rows) == 12
    ((name, _, ours_mm, first_mm, *_),) = touched.rows
    assert name == "stand_bottle, bottle"
    assert 2.0 * float(ours_mm.split()[0]) < float(first_mm.split()[0])
    # The camera looks down at 46°, from 0.75 m, with a focal length of 1.18 images: a click of sd
    # 1 px is off by 0.75 m / (1.18 · 480) across, and more along the view; medians of both.
    across_mm = 750 / (1.18 * 480)
    expected_mm = np.sqrt(2 * np.log(2)) * across_mm / np.sqrt(np.sin(np.deg2rad(46)))
    off_mm = {px: report.data[f"clicks, {px} px of 480"]["off_mm"] for px in (0, 1, 2, 3)}
    assert off_mm[0] < 0.5
    for noise_px in (1, 2, 3):
        assert off_mm[noise_px] == pytest.approx(noise_px * expected_mm, rel=0.3)


def test_no_take_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="at least 1"):
        objects.measure(options("--takes", "0"), tmp_path, bar)
