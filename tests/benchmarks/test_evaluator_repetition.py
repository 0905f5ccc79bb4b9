"""Whether a run of the evaluator repeats an earlier one."""

import json
from dataclasses import replace

import pytest

from benchmarks.evaluator.drawn import Line
from benchmarks.evaluator.keeping import read_lines, repetition
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError


def _line(what: str, value: float | None, unit: str = "") -> Line:
    return Line("stack_bowls", what, value, None, 10, "at least", 0.9, unit)


@pytest.fixture
def path(tmp_path):
    lines = [
        {"task": "stack_bowls", "what": "AUC", "value": 0.95, "unit": "", "num": 7},
        {"task": "stack_bowls", "what": "image", "value": 25.0, "unit": "dB"},
        {"task": "stack_bowls", "what": "peak", "value": 1.0, "unit": "kPa"},
        {"task": "stack_bowls", "what": "undefined", "value": None},
        {"task": "open_drawer", "what": "AUC", "value": 0.1},
    ]
    path = tmp_path / "evaluator.json"
    path.write_text(json.dumps({"lines": lines, "notes": []}))
    return path


def test_figures_are_compared_with_their_own_and_within_their_tolerance(path):
    lines = [
        _line("AUC", 0.88),
        _line("image", 23.5, "dB"),
        _line("peak", 9.0, "kPa"),
        _line("undefined", 0.5),
        _line("not there before", 0.5),
    ]
    area, image = repetition(lines, read_lines(path))
    assert area.figure == pytest.approx(0.07)
    assert image.figure == pytest.approx(1.5)
    assert (area.is_met, image.is_met) == (True, False)
    assert "0.950" in area.what


def test_figures_of_few_starts_may_differ_by_what_their_intervals_say(path):
    lines = [
        {"task": "stack_bowls", "what": name, "value": 0.9, "interval": [0.7, 1.0]}
        for name in ("Pearson", "MMRV")
    ]
    path.write_text(json.dumps({"lines": lines}))
    # Half widths of 0.15 and 0.2 give 0.25.
    now = [
        replace(_line("Pearson", 0.66), interval=(0.5, 0.9)),
        replace(_line("MMRV", 0.64), interval=(0.5, 0.9)),
    ]
    near, far = repetition(now, read_lines(path))
    assert near.bound == pytest.approx(0.25)
    assert (near.is_met, far.is_met) == (True, False)


def test_a_figure_that_is_gone_does_not_count_as_repeated(path):
    (gone,) = repetition([_line("AUC", None)], read_lines(path))
    assert gone.is_met is None


def test_other_files_are_refused(path):
    with pytest.raises(NotFoundError, match="--repeats"):
        read_lines(path.with_name("none.json"))
    path.write_text('{"lines": 3}')
    with pytest.raises(CorruptDataError, match=r"not the evaluator\.json"):
        read_lines(path)


def test_a_run_of_other_tasks_is_no_repetition(path):
    with pytest.raises(InvalidInputError, match="none of 1 lines"):
        repetition([_line("something else", 0.5)], read_lines(path))
