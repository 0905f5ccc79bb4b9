"""Commands' parser and JSON: one spelling, help stays as written, `-` is stdout alone."""

import argparse
import json
import sys

import pytest

from dextouch.command_line import (
    CommandParser,
    ProgressLines,
    add_json,
    messages_aside,
    progress,
    write_result,
)
from dextouch.errors import StorageError


def parser():
    made = CommandParser(prog="dextouch probe", description="One\nparagraph.\n\n  two\n    lines")
    made.add_argument("--num-steps", type=int)
    made.add_argument("--mock", action=argparse.BooleanOptionalAction)
    add_json(made)
    return made


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--num-steps", "8"], (8, None)),
        (["--num-steps=8"], (8, None)),
        (["--mock"], (None, True)),
        (["--no-mock"], (None, False)),
    ],
)
def test_flags_are_read(flags, expected):
    options = parser().parse_args(flags)
    assert (options.num_steps, options.mock) == expected


@pytest.mark.parametrize("flags", [["--num", "8"], ["--num_steps", "8"], ["--mock", "true"]])
def test_other_spellings_are_refused(flags):
    with pytest.raises(SystemExit, match="2"):
        parser().parse_args(flags)


def test_help_wraps_paragraphs_and_keeps_examples(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert "\nOne paragraph.\n\n  two\n    lines\n" in parser().format_help()


def test_a_result_is_written_to_a_new_folder(tmp_path):
    write_result(tmp_path / "new" / "a.json", {"name": "Größe"})
    assert (tmp_path / "new" / "a.json").read_text(encoding="utf-8").endswith("\n")
    assert json.loads((tmp_path / "new" / "a.json").read_text(encoding="utf-8")) == {
        "name": "Größe"
    }
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_result(tmp_path / "b.json", float("nan"), allow_nan=False)
    with pytest.raises(StorageError, match=f"--json {tmp_path}: Is a directory"):
        write_result(tmp_path, {})


@pytest.mark.parametrize("flags", [["--json", "-"], ["--json=-"]])
def test_a_dash_leaves_standard_output_to_the_result(flags, capsys):
    options = parser().parse_args(flags)
    with messages_aside(flags):
        sys.stdout.write("a message\n")
        write_result(options.json, [1])
    told = capsys.readouterr()
    assert (json.loads(told.out), told.err) == ([1], "a message\n")


def test_messages_stay_where_they_are_without_a_dash(capsys):
    with messages_aside(["--json", "report.json"]):
        sys.stdout.write("a message\n")
    assert capsys.readouterr().out == "a message\n"


def test_progress_prints_lines_where_no_terminal_is(capsys):
    times_s = iter([0.0, 1.0, 4.9, 5.0, 6.0, 11.0])
    lines = ProgressLines("export", clock_s=lambda: next(times_s))
    for done in range(4):
        lines.show(f"{done} of 9")
    lines.show("9 of 9", is_last=True)
    assert capsys.readouterr().err.splitlines() == ["   export 2 of 9", "   export 9 of 9"]


def test_progress_without_a_bar_prints_lines_on_a_terminal_too(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    for has_bar in (True, False):
        ProgressLines(f"bar {has_bar}", has_bar=has_bar).show("9 of 9", is_last=True)
    assert capsys.readouterr().err == "   bar False 9 of 9\n"


def test_progress_of_items_ends_with_a_line(capsys):
    assert list(progress(iter("abc"), "export mcap", 3)) == ["a", "b", "c"]
    out, err = capsys.readouterr()
    assert (out, err) == ("", "   export mcap 3 of 3\n")
