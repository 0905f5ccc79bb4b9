"""`python -m benchmarks views`: a second of training of each model goes the whole way."""

from contextlib import nullcontext

import pytest

from benchmarks import views
from benchmarks.command import stage_parser


@pytest.mark.slow
def test_each_model_is_compared_with_the_one_without(tmp_path):
    parser = stage_parser("views")
    views.add_options(parser)
    options = parser.parse_args(["--quick"])
    report = views.measure(options, tmp_path, lambda *_: nullcontext(lambda _: None))
    assert [len(table.rows) for table in report.tables] == [3, 3, 3]
    for table in report.tables:
        base, other, difference = (float(row[1]) for row in table.rows)
        assert difference == pytest.approx(other - base, rel=0.05, abs=2.0)
        assert base > 0
