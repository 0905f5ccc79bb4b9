"""The frame of `python -m benchmarks`: rounds, figures, the chart, options and exit status."""

import json
import re
import sys
import types
import xml.etree.ElementTree as ET

import pytest

from benchmarks import __main__ as entry_point
from benchmarks import command
from benchmarks.chart import Panel, Point, draw
from benchmarks.figures import Figure, Requirement, interleaved
from benchmarks.report import NOT_INSTALLED, ResultTable, StageReport, describe_machine
from benchmarks.stages import STAGES, StageEntry
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError


def test_rounds_are_taken_in_turns():
    order = []
    subjects = {name: lambda k, name=name: order.append(name) or (name, k) for name in "abc"}
    steps = []
    results = interleaved(subjects, 4, on_step=steps.append)
    assert "".join(order) == "abcbcacababc"
    assert steps == order
    assert results["b"] == [("b", 0), ("b", 1), ("b", 2), ("b", 3)]


def test_no_round_is_refused():
    with pytest.raises(InvalidInputError, match="got 0"):
        interleaved({"a": lambda _: None}, 0)


def test_figures_keep_every_round():
    figure = Figure.of([4.0, 1.0, 3.0])
    assert (figure.median, figure.low, figure.high) == (3, 1, 4)
    assert figure.text() == "3 ±1.5"
    assert Figure.of([2.0]).text() == "2"
    assert figure.scaled(2.0).values == (8, 2, 6)
    assert figure.inverse(12.0).values == (3, 12, 4)


def test_ratios_are_taken_round_by_round():
    """The second round was twice as slow for both: the ratio does not see it."""
    assert Figure.of([6.0, 12.0, 7.0]).over(Figure.of([2.0, 4.0, 1.0])).values == (3, 3, 7)
    with pytest.raises(InvalidInputError, match="3 and 1 rounds"):
        Figure.of([1.0, 2.0, 3.0]).over(Figure.of([1.0]))


@pytest.mark.parametrize("values", [(), (1.0, float("nan")), (float("inf"),)])
def test_figures_are_finite(values):
    with pytest.raises(InvalidInputError):
        Figure(values)


@pytest.mark.parametrize(
    ("figure", "sense", "verdict"),
    [
        (2.0, "at least", "pass"),
        (1.9, "at least", "FAIL"),
        (2.0, "at most", "pass"),
        (2.1, "at most", "FAIL"),
        (None, "at most", "not measured"),
    ],
)
def test_verdicts(figure, sense, verdict):
    assert Requirement("speed", figure, sense, 2.0).verdict() == verdict


SVG = "{http://www.w3.org/2000/svg}"


def places(svg):
    """Pixels (x right, y down) of the markers, by the label of their design."""
    groups = {g.get("id"): g for g in ET.fromstring(svg).iter(f"{SVG}g")}  # noqa: S314 (our own)
    markers = {name: next(g.iter(f"{SVG}use"), None) for name, g in groups.items()}
    return {n: (float(m.get("x")), float(m.get("y"))) for n, m in markers.items() if m is not None}


def test_the_chart_puts_time_right_and_error_up():
    points = [
        Point("quick & wrong", 1.0, 0.9, 1.1, 8.0, is_ours=True),
        Point("slow", 10.0, 9.0, 12.0, 2.0, is_ours=False),
    ]
    empty = Panel("Reading", "seconds", "error", [])
    svg = draw([Panel("Writing", "seconds", "error", points), empty], title="bench")
    (quick_x, wrong_y), (slow_x, right_y) = (
        places(svg)[f"Writing: {point.label}"] for point in points
    )
    assert quick_x < slow_x
    assert wrong_y < right_y  # pixels count downwards
    assert "quick &amp; wrong</text>" in svg
    assert "Writing</text>" in svg
    assert "Reading" not in svg


def test_the_machine_is_described():
    about = describe_machine(["numpy", "no-such-package"])
    assert about["no-such-package"] == NOT_INSTALLED
    assert about["numpy"][0].isdigit()
    assert int(about["cores"]) >= 1
    assert "GiB" in about["memory"]


def test_a_process_with_shape_checks_is_refused():
    """This very process has them."""
    with pytest.raises(ConflictError, match="separate process"):
        command.main(["store", "--quick"])


def test_unknown_stages_name_the_known_ones():
    with pytest.raises(UnknownNameError, match="store"):
        command.main(["espresso"])


def test_help_lists_every_stage(capsys):
    assert command.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in STAGES)


@pytest.mark.parametrize("name", sorted(STAGES))
def test_every_stage_teaches(name, capsys):
    with pytest.raises(SystemExit) as stop:
        command.main([name, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(word in text for word in ("--json", "--out", "--check", "--quick"))
    # argparse breaks lines, also after a hyphen.
    assert "".join(STAGES[name].teaches.split()) in "".join(text.split())


@pytest.mark.parametrize("name", sorted(STAGES))
def test_flags_have_dashes_and_the_example_is_taken(name):
    parser = command.stage_parser(name)
    command.load_stage(name).add_options(parser)
    text = parser.format_help()
    assert text.startswith(f"usage: python -m benchmarks {name} ")
    example = text.partition("example:\n")[2].split()
    assert example[:4] == ["python", "-m", "benchmarks", name]
    parser.parse_args(example[4:])
    for action in parser._actions:
        assert not any("_" in flag for flag in action.option_strings)
        assert re.sub(r"\((default|required).*\)", "", action.help or ""), action.dest


def test_refusals_are_one_line_without_a_traceback(monkeypatch, capsys):
    assert entry_point.main(["espresso"]) == 3
    told = capsys.readouterr().err
    assert told.startswith("benchmarks: unknown stage 'espresso'; valid: ")
    assert len(told.splitlines()) == 1

    def without_mujoco(argv):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setattr(command, "main", without_mujoco)
    assert entry_point.main(["twin"]) == 3
    assert "[twin]" in capsys.readouterr().err


def test_a_result_on_standard_output_stands_alone(fake_stage, capsys):
    assert entry_point.main(["fake", "--figure", "1", "--json", "-"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["designs"] == {"ours": [1.0]}
    assert "rival is left out" in told.err


@pytest.fixture
def fake_stage(monkeypatch):
    """A stage that measures at once; its figure is what the command line says."""
    module = types.ModuleType("fake_stage")

    def add_options(parser):
        parser.add_argument("--figure", type=float)

    def measure(options, folder, bar):
        assert list(folder.iterdir()) == []
        (folder / "something").write_text("written")
        with bar("measuring", 1) as step:
            step("it")
        figure = options.figure
        point = Point("ours", 1.0, 1.0, 1.0, 2.0, is_ours=True)
        return StageReport(
            stage="fake",
            packages=["numpy"],
            options={},
            tables=[ResultTable("Results", ("design", "time"), [("ours", "1 [s]")])],
            requirements=[Requirement("speed", figure, "at least", 2.0, "m/s")],
            data={"designs": {"ours": Figure.of([figure or 0.0])}},
            panels=[Panel("Speed", "s", "error", [point])],
            notes=["rival is left out"],
        )

    module.add_options, module.measure = add_options, measure
    monkeypatch.setitem(sys.modules, "fake_stage", module)
    monkeypatch.setitem(STAGES, "fake", StageEntry("fake_stage", "does nothing", "Reports it."))
    monkeypatch.setattr(command, "refuse_shape_checks", lambda: None)


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (["--figure", "1"], 0),
        (["--figure", "1", "--check"], 1),
        (["--figure", "3", "--check"], 0),
        (["--check"], 1),
    ],
)
def test_a_missed_bound_fails_only_with_check(fake_stage, words, status, capsys):
    assert command.main(["fake", *words]) == status
    text = capsys.readouterr().out
    assert "rival is left out" in text
    assert ("FAIL" in text) == ("1" in words)


def test_json_and_folder_are_written(fake_stage, tmp_path, capsys):
    out = tmp_path / "out"
    (out / "written").mkdir(parents=True)
    (out / "written" / "old").write_text("of the run before")
    command.main(
        ["fake", "--figure", "1", "--json", str(tmp_path / "a" / "b.json"), "--out", str(out)]
    )
    report = json.loads((tmp_path / "a" / "b.json").read_text())
    assert report["designs"] == {"ours": [1.0]}
    assert report["requirements"][0]["verdict"] == "FAIL"
    assert (out / "bench_fake.json").read_text() == (tmp_path / "a" / "b.json").read_text()
    assert (out / "bench_fake.svg").is_file()
    text = (out / "bench_fake.md").read_text()
    assert "| design | time |\n| --- | --- |\n| ours | 1 [s] |\n" in text
    assert "| speed | 1 | at least 2 m/s | FAIL |" in text
    assert [p.name for p in (out / "written").iterdir()] == ["something"]
    assert "chart" in capsys.readouterr().out


def test_without_a_folder_nothing_is_kept(fake_stage, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    command.main(["fake", "--figure", "1"])
    assert list(tmp_path.iterdir()) == []
