"""`python -m benchmarks closure`: one take; a copied wrist holds nothing, our method does."""

from contextlib import contextmanager

import pytest

from benchmarks.closure import benchmark
from benchmarks.command import stage_parser
from dextouch.errors import InvalidInputError


def options(*arguments):
    parser = stage_parser("closure")
    benchmark.add_options(parser)
    return parser.parse_args(list(arguments))


def test_a_quick_run_replays_one_take(tmp_path):
    steps = []

    @contextmanager
    def bar(_, total):
        steps.append(total)
        yield steps.append

    report = benchmark.measure(options("--quick", "--tasks", "stand_bottle"), tmp_path, bar)
    assert steps[0] == 2 == len(steps) - 1
    assert list(report.data["succeeded"].values()) == [[False], [True]]
    assert report.is_met
    (table,) = report.tables
    assert [row[1] for row in table.rows] == ["0.00", "1.00"]


def test_no_take_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="at least 1"):
        benchmark.measure(options("--takes", "0"), tmp_path, lambda *_: None)
