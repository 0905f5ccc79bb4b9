"""`python -m benchmarks objects`: one take of a task by both designs."""

from contextlib import nullcontext

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
    (table,) = report.tables
    assert [row[1] for row in table.rows] == [objects.OURS, objects.USUAL] * len(objects.LOOKS)
    sharp = [
        report.data[f"{objects.SIDES_PX[0]} px, sharp, {design}"] for design in objects.DESIGNS
    ]
    ours, usual = (one["off_mm"] for one in sharp)
    assert ours < 2.5 < usual


def test_no_take_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="at least 1"):
        objects.measure(options("--takes", "0"), tmp_path, bar)
