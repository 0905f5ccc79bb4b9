"""Scripts with mistakes in the stage `evaluator`: which are rolled out, and lines by hand."""

import argparse
from dataclasses import replace

import pytest
import torch

from benchmarks.evaluator import lines, work
from benchmarks.evaluator.benchmark import add_options, figures_of_tasks, row_table
from benchmarks.evaluator.drawn import Rolled
from benchmarks.evaluator.keeping import KeptRows
from benchmarks.evaluator.lines import VERDICTS, TaskFigures, uncertainty_of
from benchmarks.evaluator.plan import KindsPlan, StudyPlan, Trained, mistakes_digest
from dextouch.errors import InvalidInputError, UnknownNameError
from services.evaluation.settings import DEFAULT_PROBE
from services.twin.mistakes import DEVELOPMENT, HELD_OUT, TRAINING

EACH = "mistakes (development), imagined against real, each rollout"
POLICIES = "policies (development kinds and strengths)"


def test_sets_of_kinds_by_name():
    assert KindsPlan.parse("none") is None
    for name, kinds in (
        ("development", DEVELOPMENT), ("held-out", HELD_OUT), ("training", TRAINING),
    ):  # fmt: skip
        assert KindsPlan.parse(name).kinds == tuple(kinds)
    chosen = KindsPlan.parse("tilt,height,tilt", (0.5,))
    assert (chosen.name, chosen.kinds, chosen.strengths) == ("chosen", ("tilt", "height"), (0.5,))
    with pytest.raises(UnknownNameError, match="held-out"):
        KindsPlan.parse("lean")
    for strengths in ((), (0.5, 0.5)):
        with pytest.raises(InvalidInputError, match="no strength twice"):
            KindsPlan.parse("tilt", strengths)


def test_held_out_kinds_are_rolled_out_only_on_request():
    parser = argparse.ArgumentParser()
    add_options(parser)
    assert parser.parse_args([]).kinds == "development"
    assert "held-out once" in " ".join(parser.format_help().split())


def test_each_kind_has_every_strength_in_turn():
    plan = KindsPlan("some", ("tilt", "yaw"), (0.1, 0.2, 0.3))
    starts = [plan.policies(seed) for seed in range(40, 43)]
    assert all(len(names) == 2 for names in starts)
    assert {name for names in starts for name in names} == {
        f"{kind} {strength}" for kind in ("tilt", "yaw") for strength in (0.1, 0.2, 0.3)
    }
    # The strength of a kind does not depend on the other kinds.
    alone = replace(plan, kinds=("yaw",))
    assert [names[1:] for names in starts] == [alone.policies(seed) for seed in range(40, 43)]
    assert len(replace(plan, every_strength=True).policies(40)) == 6


def _verdict(told, decision=None):
    likely = "success" if told >= 0.5 else "failure"
    return {"probability": told, "likely_success": told >= 0.5, "decision": decision or likely}


def _rolled(policy, seed, *, real, told, decision=None):
    rows = {"true verdict": _verdict(float(real)), "imagined verdict": _verdict(told, decision)}
    return Rolled(policy, seed, real, rows)


@pytest.fixture
def rolled():
    return [
        _rolled("overshoot 0.2", 1, real=True, told=0.9),
        _rolled("overshoot 0.8", 2, real=False, told=0.2),
        _rolled("frame_yaw 0.8", 1, real=False, told=0.6, decision="cannot tell"),
        _rolled("frame_yaw 0.2", 2, real=True, told=0.4),
    ]


def test_lines_by_hand(rolled):
    lines = {line.what: line for line in TaskFigures("a", [rolled], (), "development").lines()}
    # 0.9 and 0.4 against 0.2 and 0.6: three pairs of four.
    area = lines[f"{EACH}, AUC"]
    assert (area.value, area.sense, area.bound, area.num) == (0.75, "at least", 0.90, 4)
    assert lines[f"{EACH}, balanced accuracy"].value == 0.5
    bias = lines["mistakes (development), bias of the success rate"]
    assert (bias.value, bias.sense, bias.bound) == (0.0, "at most", 0.08)
    wrong = lines["mistakes (development), wrong among the decided"]
    assert (wrong.value, wrong.num, wrong.bound) == (pytest.approx(1 / 3), 3, 0.10)
    decided = lines["mistakes (development), decided"]
    assert (decided.value, decided.sense, decided.bound) == (0.75, "at least", 0.60)
    # Doubts of wrong verdicts are 1 + 0.8 and 0.8, of right ones 0.2 and 0.4.
    uncertainty = lines["mistakes (development), uncertainty of wrong verdicts, AUC"]
    assert (uncertainty.value, uncertainty.bound) == (1.0, 0.80)
    assert lines["mistakes (development), judge on true endings, AUC"].value == 1.0
    # Rates of the four policies, real 1 0 0 1 and imagined 1 0 1 0.
    assert lines[f"{POLICIES}, Pearson"].value == pytest.approx(0.0)
    violated = lines[f"{POLICIES}, MMRV with ties"]
    # The second is above no other in either world, each of the others above one in one world only.
    assert (violated.value, violated.num, violated.bound) == (0.75, 4, 0.12)
    # Of both kinds, half succeeds in both worlds.
    assert lines["policies (development kinds), MMRV with ties"].value == 0.0
    assert lines["policies (development kinds), Pearson"].text(None) == "undefined (2 policies)"


def test_the_bias_has_no_sign(rolled):
    optimistic = [
        replace(one, rows=one.rows | {"imagined verdict": _verdict(0.1)}) for one in rolled
    ]
    lines = {line.what: line for line in TaskFigures("a", [optimistic], (), "some").lines()}
    bias = lines["mistakes (some), bias of the success rate"]
    assert bias.value == 0.5
    assert bias.interval[0] >= 0


def test_rows_by_kind_stand_beside_the_ladder(rolled):
    last = {"verdict of the last image": _verdict(0.6)}
    figures = {"contact": [[1.0, 1.0, 1.0]] * 2, "contact_of_copy": [[1.0, 1.0, 1.0]] * 2}
    images = {"psnr": [[1.0, 1.0]] * 2, "psnr_of_objects": [[1.0, 1.0]] * 2}
    ladder = [
        replace(one, rows=one.rows | last | {"imagined": figures | images})
        for one in (_rolled("script 0 mm", seed, real=seed == 1, told=0.3) for seed in (1, 2))
    ]
    better = [
        replace(one, rows=one.rows | {"imagined verdict": _verdict(float(one.success))})
        for one in rolled
    ]
    task = TaskFigures("a", [rolled + ladder, better + ladder], ("script 0 mm",), "development")
    rows = {row["mistakes"]: row for row in task.kind_rows()}
    assert list(rows) == ["position (ladder)", "all development", "overshoot", "frame_yaw"]
    ours = rows["position (ladder)"]
    assert (ours["rollouts"], ours["real"], ours["imagined"], ours["auc"]) == (2, 0.5, 0.0, 0.5)
    every = rows["all development"]
    assert (every["auc"], every["auc_least"], every["auc_greatest"]) == (0.875, 0.75, 1.0)
    assert (rows["overshoot"]["auc"], rows["frame_yaw"]["auc"]) == (1.0, 0.5)
    assert rows["overshoot"]["auc_of_uncertainty"] is None
    table = row_table("kinds", task.kind_rows())
    assert table.rows[1][:3] == ("a", "all development", "4")
    # Lines of the ladder are about the ladder alone.
    lines = {line.what: line for line in task.lines()}
    assert lines["imagined against real, each rollout, AUC"].num == 2
    assert lines[f"{EACH}, AUC, worst training seed"].value == 0.75
    assert {row["policy"] for row in task.policy_rows()} >= {"overshoot 0.2", "script 0 mm"}
    assert {row["succeeded"] for row in task.rival_rows()} == {0.5}


def test_open_verdicts_are_more_doubtful_than_decided_ones():
    told = [("success", 0.98), ("failure", 0.4), ("cannot tell", 0.95), ("cannot tell", 0.55)]
    uncertainties = [
        uncertainty_of({"probability": p, "decision": decision}) for decision, p in told
    ]
    assert uncertainties == sorted(uncertainties)


def test_policies_of_other_names_have_no_kind():
    with pytest.raises(ValueError, match="script 0 mm"):
        lines.kind_of(_rolled("script 0 mm", 1, real=True, told=0.5))


def test_only_endings_of_mistakes_are_rolled_out_and_kept(tmp_path, monkeypatch):
    torch.set_num_threads(1)
    trained = (Trained(None, DEFAULT_PROBE),)
    kinds = KindsPlan("some", ("overshoot",), (0.3,))
    plan = StudyPlan(tmp_path, trained, ("stand_bottle",), (39_077,), (), kinds)
    assert plan.policies == ()
    study, path = work.Study(plan), tmp_path / "rollouts.jsonl"
    missing = study.missing(KeptRows(path), "stand_bottle", 39_077)
    assert missing == {"overshoot 0.3": tuple((kind, 0) for kind in VERDICTS)}
    shown = []

    def noted(play):
        def noting(*arguments, **options):
            shown.append(play(*arguments, **options).images_of_chunks.shape)
            return play(*arguments, **options)

        return noting

    for name in ("play_in_twin", "play_in_imagination"):
        monkeypatch.setattr(work, name, noted(getattr(work, name)))
    kept = KeptRows(path)
    kept.add(study.rows("stand_bottle", 39_077, missing))
    assert [shape[0] for shape in shown] == [0, 0]
    assert study.missing(KeptRows(path), "stand_bottle", 39_077) == {}
    figures, failed = figures_of_tasks(study, kept)
    assert (failed, figures[0].policy_rows()[0]["policy"]) == (0, "overshoot 0.3")
    assert all(mistakes_digest()[:12] in str(one) for one in (tmp_path / "arrays").rglob("*.npz"))
    # Other code of the mistakes: other commands.
    monkeypatch.setattr(work, "mistakes_digest", lambda: "0" * 64)
    assert study.missing(kept, "stand_bottle", 39_077) == missing
