"""Reproduction: steps run once, in order and again only if changed; tables of known results."""

import json
import math
import re
import signal
import subprocess
import sys
import textwrap
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from benchmarks.command import stage_parser
from benchmarks.reproduction import benchmark
from benchmarks.reproduction.experiments import ADAPTED, QUICK, TABLES, Experiments, Sizes
from benchmarks.reproduction.steps import Step, run
from benchmarks.reproduction.tables import (
    METRICS,
    Measured,
    Page,
    Row,
    data_table,
    estimate_figures,
    make_pages,
)
from dextouch.errors import NotFoundError
from services.cli.main import find_command, main
from services.evaluation.scores import ClosedLoopReport, RolloutScore
from services.evaluation.studies.results import StudyHeader, StudyResults, read_definition
from services.twin.names import DOWNSTREAM

# A command that appends its last word to a file and writes the result that its first word names.
PROGRAM = (
    sys.executable,
    "-c",
    "import sys, pathlib as p\n"
    "made, word = sys.argv[1:]\n"
    "with open('ran.txt', 'a') as f: f.write(word + ' ')\n"
    "p.Path(made).write_text(word)\n"
    "sys.exit({'bad': 4, 'lenient': 1}.get(word, 0))\n",
)


def a_step(name, word=None, needs=(), exits=(0,)):
    return Step(name, f"{name}/made {word or name}", ("made",), needs, exits=exits)


def ran(folder: Path) -> list[str]:
    path = folder / "ran.txt"
    words = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return words


def run_them(folder, *steps, jobs=1):
    return run(steps, folder, jobs, PROGRAM)


def test_steps_run_once_in_the_order_of_their_needs(tmp_path):
    first = a_step("a")
    second = a_step("b/1", needs=(first,))
    steps = (a_step("c", needs=(second,)), second, first)
    assert run_them(tmp_path, *steps) == []
    assert ran(tmp_path) == ["a", "b/1", "c"]
    assert run_them(tmp_path, *steps) == []
    assert ran(tmp_path) == []


def test_steps_that_do_not_need_each_other_run_at_once(tmp_path):
    """Each waits for the file of the other."""
    program = (
        sys.executable,
        "-c",
        "import sys, time, pathlib as p\n"
        "made, other = sys.argv[1:]\n"
        "p.Path(made).touch()\n"
        "while not p.Path(other).exists(): time.sleep(0.01)\n",
    )
    steps = (Step("a", "a/made b/made", ("made",)), Step("b", "b/made a/made", ("made",)))
    assert run(steps, tmp_path, 2, program) == []


def test_a_receipt_says_what_was_run_and_how_long(tmp_path):
    step = a_step("a")
    assert step.receipt(tmp_path) is None
    run_them(tmp_path, step)
    receipt = step.receipt(tmp_path)
    assert receipt["command"] == "dextouch a/made a"
    # A Python process takes more than a millisecond, and this one no minute.
    assert 0.001 < receipt["cpu_s"] < 60
    assert 0.001 < receipt["wall_s"] < 60
    assert replace(step, command="other").receipt(tmp_path) is None


def test_a_changed_command_repeats_what_depends_on_it_without_the_old_results(tmp_path):
    first = a_step("a")
    run_them(tmp_path, first, a_step("b", needs=(first,)), a_step("c"))
    ran(tmp_path)
    (tmp_path / "b" / "left over").write_text("from before")
    first = a_step("a", "other")
    run_them(tmp_path, first, a_step("b", needs=(first,)), a_step("c"))
    assert ran(tmp_path) == ["other", "b"]
    assert not (tmp_path / "b" / "left over").exists()


def test_a_step_whose_result_is_gone_is_repeated(tmp_path):
    run_them(tmp_path, a_step("a"))
    ran(tmp_path)
    (tmp_path / "a" / "made").unlink()
    run_them(tmp_path, a_step("a"))
    assert ran(tmp_path) == ["a"]


def test_steps_that_need_a_failed_one_do_not_run_and_others_do(tmp_path, capsys):
    bad = a_step("a", "bad")
    assert run_them(tmp_path, bad, a_step("b", needs=(bad,)), a_step("c")) == ["a"]
    assert ran(tmp_path) == ["bad", "c"]
    assert "a: FAILED; the end of" in capsys.readouterr().out


def test_a_step_without_its_result_has_failed(tmp_path):
    step = replace(a_step("a"), makes=("made", "never made"))
    assert run_them(tmp_path, step) == ["a"]


def test_an_allowed_exit_status_counts_as_done(tmp_path):
    assert run_them(tmp_path, a_step("a", "lenient", exits=(0, 1))) == []


def test_an_interrupted_run_stops_its_command_and_resumes_in_its_folder(tmp_path):
    """The parent gets SIGINT while the command sleeps; what the command left is there again."""
    slow = tmp_path / "slow.py"
    slow.write_text(
        textwrap.dedent(
            """
            import signal, sys, time, pathlib as p

            def stop(*_):
                p.Path("a/stopped").touch()
                sys.exit(1)

            if p.Path("a/partial").exists():
                p.Path("a/made").touch()
            else:
                signal.signal(signal.SIGTERM, stop)
                p.Path("a/partial").touch()
                time.sleep(600)
            """
        )
    )
    script = textwrap.dedent(
        """
        import signal
        import sys
        from pathlib import Path
        from benchmarks.reproduction.steps import Step, run
        # Shells let commands in the background ignore it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        folder = Path(sys.argv[1])
        run((Step("a", str(folder / "slow.py"), ("made",)),), folder, 1, (sys.executable,))
        """
    )
    arguments = [sys.executable, "-c", script, str(tmp_path)]
    partial = tmp_path / "a" / "partial"
    with subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as child:
        deadline_s = time.monotonic() + 60
        while not partial.exists() and time.monotonic() < deadline_s:
            time.sleep(0.02)
        child.send_signal(signal.SIGINT)
        try:
            assert child.wait(60) != 0
        finally:
            child.kill()
    assert (tmp_path / "a" / "stopped").exists()
    assert subprocess.run(arguments, timeout=60, check=False, capture_output=True).returncode == 0
    assert (tmp_path / "a" / "made").exists()


def test_every_step_is_a_command_of_ours_with_flags_that_it_has(capsys):
    flags: dict[str, set[str]] = {}
    for step in Experiments(Sizes(), (0, 1)).steps(TABLES):
        words = step.command.split()
        find_command(words)
        name = re.match(r"[a-z]+( [a-z][a-z-]+)*(?= -| [^ ]*/)", step.command)[0]
        name += " --preset tiny" if "--preset" in words else ""
        flags.setdefault(name, set()).update(word for word in words if word.startswith("--"))
    for name, given in flags.items():
        with pytest.raises(SystemExit):
            main([*name.split(), "--help"])
        text = capsys.readouterr().out
        assert {flag for flag in given if flag not in text} == set(), name


def test_a_table_takes_only_the_steps_it_needs():
    names = {step.name for step in Experiments(QUICK, (0,)).steps(["design"])}
    assert "design/V-only/seed-0/prediction" in names
    assert "data/robot" in names
    assert not any(name.startswith(("scaling", "evaluator", "data/human")) for name in names)


def test_studies_are_read_by_the_command_that_runs_them(tmp_path):
    studies = [step for step in Experiments(Sizes(), (0, 1)).steps(TABLES) if step.inputs]
    assert [step.name for step in studies] == ["evaluator/study", "generation/study"]
    for step in studies:
        ((_, text),) = step.inputs
        path = tmp_path / "study.toml"
        path.write_text(text)
        assert read_definition(path).num_starts == Sizes().num_starts
    assert len(read_definition(path).policies) == 8


def test_models_of_scaling_differ_in_human_data_and_one_in_its_length():
    steps = {step.name: step for step in Experiments(QUICK, (0, 1)).steps(["scaling"])}
    assert "scaling/0/seed-1/prediction" in steps
    assert not any(name.startswith("design") for name in steps)
    for column, count in (("0", 4), ("0-half-as-long", 2), ("1x", 4)):
        command = steps[f"scaling/{column}/seed-0/model"].command
        assert f"--core.num-steps {count} " in command
        assert f"--reader.num-steps {count} " in command
        assert ("--human data/human/store" in command) is (column == "1x")


def test_predictions_without_a_model_are_measured_once():
    steps = {step.name: step for step in Experiments(QUICK, (0, 1)).steps(["design"])}
    with_copy = [name for name, step in steps.items() if "copy" in step.command]
    assert with_copy == ["design/Robot-only/seed-0/prediction"]


def test_the_interval_is_students():
    # t of 0.975 with 2 degrees of freedom is 4.3027 (any table of Student's t).
    measured = Measured((1.0, 2.0, 4.5))
    mean, spread = 2.5, math.sqrt(((1.5) ** 2 + 0.5**2 + 2.0**2) / 2)
    assert measured.mean == pytest.approx(mean)
    assert measured.half_width == pytest.approx(4.3027 * spread / math.sqrt(3), rel=1e-4)
    assert Measured((3.0,)).text() == "3"
    assert Measured((math.nan, math.nan)).text() == "n/a"
    assert Measured((0.1, 0.1, 0.1)).text() == "0.1000 ± 0.0000"
    assert Measured((0.0, 0.0)).text() == "0.0000 ± 0.0000"


def test_differences_are_taken_seed_by_seed():
    row = Row(
        "PSNR",
        {"a": Measured((20.0, 30.0)), "b": Measured((21.0, 31.0))},
        {"a": 19.5},
        higher_is_better=True,
    )
    table, differences = Page("T", (row,), "a").tables()
    assert table.rows[0][1].endswith("(paper 19.5)")
    assert differences.title == "T: difference from a, seed by seed"
    assert differences.columns == ("", "b")
    assert differences.rows == [("PSNR ↑", "+1.0000 ± 0.0000")]


def test_a_prediction_table_reads_the_figures_of_its_steps(tmp_path):
    experiments = Experiments(QUICK, (0, 1))
    for column, base in (("V-only", 20.0), ("Cross-Attn", 21.0), ("Robot-only", 22.0)):
        for seed in (0, 1):
            path = tmp_path / f"design/{column}/seed-{seed}/prediction/result.json"
            path.parent.mkdir(parents=True)
            figures = {key: None for _, key, _ in METRICS} | {"psnr": base + seed}
            sources = {"model": figures, "other_take": figures | {"psnr": base - 3}}
            if column == "Robot-only" and seed == 0:
                sources["copy"] = figures | {"psnr": 18.25}
            path.write_text(json.dumps({"windows": {"all": sources}}))
    (page,) = make_pages(tmp_path, experiments, "design")
    psnr = page.rows[0]
    assert psnr.cells["Cross-Attn"].mean == pytest.approx(21.5)
    assert psnr.paper["Robot-only"] == pytest.approx(23.473)
    assert page.to_json()["rows"][1]["values"]["V-only"] == [None, None]
    shown = {row[0]: row for row in page.tables()[0].rows}
    assert "SSIM ↑" not in shown
    (note,) = page.notes()
    assert "not available: SSIM, LPIPS, Aesthetic Quality" in note
    assert shown["PSNR ↑"][1].startswith("20.5")
    assert shown["PSNR ↑"][-3:] == ("18.25", "n/a", "n/a")
    assert page.to_json()["rows"][0]["references"]["copy"] == pytest.approx(18.25)
    # The base has 22 and 23 by seed, and 3 less than 22 with another take's actions in both.
    assert shown["PSNR, other actions ↓"][1] == "17.0000 ± 0.0000"


def test_a_table_of_two_policies_says_that_these_are_no_correlation(tmp_path):
    experiments = Experiments(QUICK, (0,))
    figures = {key: None for _, key, _ in METRICS} | {"psnr": 20.0}
    sources = {"model": figures, "other_take": figures}
    worlds = [f"{world} 0" for world in ADAPTED]
    for world in ADAPTED:
        path = tmp_path / f"evaluator/{world}/seed-0/prediction/result.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({"windows": {"all": sources}}))
    scores = [
        RolloutScore(world, policy, task, seed, f"{task} {seed}", seed < wins, 0.5)
        for world in ("real", *worlds)
        for task in DOWNSTREAM
        for policy, wins in (("first", 1), ("second", 2))
        for seed in range(3)
    ]
    study = ClosedLoopReport(tuple(scores), tuple(worlds), ("first", "second")).to_report()
    (tmp_path / "evaluator/study").mkdir(parents=True)
    (tmp_path / "evaluator/study/result.json").write_text(json.dumps(study))
    header = StudyHeader("evaluator", {}, {})
    results = StudyResults.create_or_resume(tmp_path / "evaluator/study/results", header)
    for one in scores:
        estimate = None if one.world == "real" else 0.9 if one.success else 0.2
        # "first" gets 0.5, 0, 0 points and "second" 1, 0.5, 0.5, in all worlds alike.
        points = (
            0.5 * (one.success + (one.policy == "second")) if one.task == DOWNSTREAM[0] else None
        )
        results.keep(replace(one, world_probability=estimate, rubric_score=points))
    pages = make_pages(tmp_path, experiments, "evaluator")
    shown = [row for page in pages for table in page.tables() for row in table.rows]
    rows = [cells for name, *cells in shown if name.startswith("Pearson, ")]
    assert sum("undefined (2 policies)" in row[0] for row in rows) == len(DOWNSTREAM)
    assert not any(cell.startswith(("1 ", "1.0")) or cell == "1" for row in rows for cell in row)
    named = {page.title: page for page in pages}
    points = named["Policy evaluation: the rubric scores"]
    has_figures = [row.metric for row in points.rows if row.is_available]
    assert has_figures == [f"MMRV, {DOWNSTREAM[0]}"]
    (auc, *_) = named["Policy evaluation: the worlds' own estimates of success"].rows
    assert {world: one.values for world, one in auc.cells.items()} == dict.fromkeys(ADAPTED, (1.0,))


def test_own_estimates_are_compared_with_success_by_hand():
    """Three policies that succeed always, at every other start, and never."""
    estimates = {"good": (0.9, 0.8), "fair": (0.45, 0.4), "poor": (0.5, 0.2)}
    wins = {"good": 2, "fair": 1, "poor": 0}
    scores, succeeded = [], {}
    for policy, own in estimates.items():
        for seed, estimate in enumerate(own):
            succeeded["reach", policy, seed] = seed < wins[policy]
            score = RolloutScore("W", policy, "reach", seed, "d", success=False, probability=0.5)
            scores.append(replace(score, world_probability=estimate))
    found = estimate_figures(scores, succeeded, "reach")
    # Of nine pairs of a success and a failure, 0.45 and 0.5 alone are in the wrong order.
    assert found.auc == pytest.approx(8 / 9)
    # Means 0.85, 0.425 and 0.35 (fair, good, poor by name) for rates of 1, 0.5 and 0.
    np.testing.assert_allclose(found.policy_means, [0.425, 0.85, 0.35])
    assert found.pearson == pytest.approx(0.25 / math.sqrt(0.5 * 0.145416667))
    assert found.mmrv == 0.0
    assert math.isnan(estimate_figures(scores, succeeded, "another").auc)


def test_the_table_of_options_has_those_that_are_measured(tmp_path):
    experiments = Experiments(QUICK, (0, 1))
    figures = {key: None for _, key, _ in METRICS} | {"psnr": 20.0}
    result = json.dumps({"windows": {"all": {"model": figures, "other_take": figures}}})
    for column, seeds in (("plain-touch", (0, 1)), ("velocity", (0,)), ("default", (0, 1))):
        for seed in seeds:
            path = tmp_path / f"options/{column}/seed-{seed}/prediction/result.json"
            path.parent.mkdir(parents=True)
            path.write_text(result)
    (page,) = make_pages(tmp_path, experiments, "options")
    assert list(page.rows[0].cells) == ["default", "plain touch"]
    assert "not measured yet: velocity, " in page.title
    (tmp_path / "options/default/seed-1/prediction/result.json").unlink()
    with pytest.raises(NotFoundError, match="options/default/seed-1"):
        make_pages(tmp_path, experiments, "options")


def test_data_are_named_once_for_all_seeds(tmp_path):
    sets = [
        {"domain": "robot", "tasks": {"insert_peg": 4, "turn_lever": 4}, "data_hash": "a" * 64},
        {"domain": "human", "tasks": {"lift_box": 9}, "data_hash": "b" * 64},
        {"domain": "robot", "tasks": {"insert_peg": 2}, "data_hash": "c" * 64, "heldout": True},
        {"domain": "robot", "tasks": {"stir": 7}, "data_hash": "d" * 64, "checkpoint": "an older"},
    ]
    notes = {"data_hash": "e" * 64, "sets": [{"heldout": False} | one for one in sets]}
    steps = [Step(f"scaling/1x/seed-{seed}/model", "", ("m.safetensors",)) for seed in (0, 1)]
    steps.append(Step("policy", "", ("p.safetensors", "result.json")))
    for step, content in zip(steps, (notes, notes, {"data_hash": "f" * 64}), strict=True):
        (tmp_path / step.name).mkdir(parents=True)
        weights = {"weight": np.zeros(1, np.float32)}
        save_file(weights, tmp_path / step.name / step.makes[0], {"about": json.dumps(content)})
    of_model, of_policy = data_table(tmp_path, steps).rows
    trained = f"8 robot ({'a' * 12}), 9 human ({'b' * 12})"
    assert of_model == ("scaling/1x/model", trained, f"2 robot ({'c' * 12})")
    assert of_policy == ("policy", "f" * 12, "")


def measured(*arguments, **changed):
    parser = stage_parser("reproduction")
    benchmark.add_options(parser)
    options = parser.parse_args(list(arguments))
    vars(options).update(changed)
    return benchmark.measure(options, Path(), lambda *_: nullcontext(lambda _: None))


def test_the_list_says_which_steps_are_done(tmp_path):
    report = measured("tokenizer", "--quick", "--seeds", "4", "--list", "--keep", str(tmp_path))
    (steps,) = report.tables
    assert [row[:2] for row in steps.rows] == [
        ("data/robot", "missing"),
        ("tokenizer/split_hands/seed-4", "missing"),
        ("tokenizer/grid/seed-4", "missing"),
    ]
    assert all(row[2].startswith("dextouch train ") for row in steps.rows)
    assert report.is_met
    assert list(tmp_path.iterdir()) == []


def test_a_step_that_fails_leaves_its_table_out(tmp_path, monkeypatch):
    def fail(steps, folder, num_jobs):
        folder.mkdir(exist_ok=True)
        return [steps[0].name]

    monkeypatch.setattr(benchmark, "run", fail)
    report = measured("tokenizer", "--quick", "--keep", str(tmp_path / "kept"))
    assert not report.is_met
    assert any(note.startswith("tokenizer: no table; ") for note in report.notes)
    assert "no table" in (tmp_path / "kept/tables.md").read_text()
    kept = json.loads((tmp_path / "kept/tables.json").read_text())
    assert kept["steps"][0] == {"step": "data/robot"}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--seeds", "1,1"], "different numbers"),
        (["--sizes", "{"], "JSON object"),
        (["--sizes", '{"num_starts": 0}'], "num_starts"),
        (["--sizes", '{"num_stars": 4}'], "num_stars"),
        (["nothing"], "tokenizer"),
    ],
)
def test_wrong_options_are_refused(words, says, capsys):
    with pytest.raises(SystemExit):
        measured(*words)
    assert says in capsys.readouterr().err


@pytest.mark.slow
def test_a_quick_run_makes_a_table(tmp_path):
    """The real commands: data and tokenizers, which take seconds."""
    sizes = '{"tokenizer_cpu_s": 2}'
    report = measured("tokenizer", "--sizes", sizes, "--seeds", "0", "--keep", str(tmp_path))
    assert report.is_met
    table = report.tables[0]
    assert table.columns == ("", "Split-Hands", "Grid")
    errors = [float(cell) for row in table.rows[:2] for cell in row[1:]]
    assert all(error > 0 for error in errors)
    # Everything is done: nothing runs again.
    again = measured("tokenizer", "--sizes", sizes, "--seeds", "0", "--keep", str(tmp_path))
    assert again.data["steps"] == report.data["steps"]
