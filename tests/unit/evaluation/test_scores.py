"""Rates, matched starts and agreement of hand-made rollouts."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from dextouch.errors import InvalidInputError
from services.evaluation.command_line import print_scores
from services.evaluation.reporting import write_report
from services.evaluation.reporting.pictures import ReportPictures
from services.evaluation.reporting.sections import latex_tables, tiles
from services.evaluation.scores import ClosedLoopReport, RolloutFailure, RolloutScore


def report(outcomes: dict[str, dict[str, str]]) -> ClosedLoopReport:
    """Outcomes as {world: {policy: "1101"}}; one task, starts numbered."""
    scores = [
        RolloutScore(
            world, policy, "stand", k, f"start {k}", mark == "1", 0.9 if mark == "1" else 0.2
        )
        for world, policies in outcomes.items()
        for policy, marks in policies.items()
        for k, mark in enumerate(marks)
    ]
    worlds = tuple(w for w in outcomes if w != "real")
    return ClosedLoopReport(tuple(scores), worlds, tuple(outcomes["real"]))


GOOD = {
    "real": {"a": "1111", "b": "1100", "c": "0000"},
    "model": {"a": "1110", "b": "1101", "c": "1000"},
    "copy": {"a": "0000", "b": "0000", "c": "0000"},
}


def test_rates_and_intervals():
    row = report(GOOD).policy_rows()[0]
    assert (row["policy"], row["task"], row["real"], row["imagined"]) == ("a", "stand", 1.0, 0.75)
    assert row["real_interval"] == pytest.approx([0.510, 1.0], abs=1e-3)
    assert row["imagined_rollouts"] == 4
    assert row["imagined_probability"] == pytest.approx((3 * 0.9 + 0.2) / 4)
    assert row["other_worlds"]["copy"]["success"] == 0.0


def test_repeats_of_a_start_do_not_narrow_its_interval():
    """Three of four starts solved, each five times: the interval is that of three of four."""
    repeated = report({"real": {"a": "1110"}})
    repeated = replace(repeated, scores=repeated.scores * 5)
    (row,) = repeated.policy_rows()
    expected = binomtest(3, 4).proportion_ci(method="wilson")
    assert row["real_interval"] == pytest.approx([expected.low, expected.high])
    assert row["real_rollouts"] == 20


def test_agreement_by_hand():
    found = report(GOOD).agreement("model")["stand"]
    real, imagined = [1, 0.5, 0], [0.75, 0.75, 0.25]
    assert found["pearson"] == pytest.approx(np.corrcoef(real, imagined)[0, 1])
    # Nothing is put in the opposite order, but a is put no higher than b: (0.5 + 0 + 0) / 3.
    assert (found["mmrv"], found["mmrv_paper"]) == (pytest.approx(0.5 / 3), 0.0)
    assert found["bias"] == pytest.approx(0.25 / 3)


def test_differences_of_the_real_world_need_no_imagined_one():
    alone = report({"real": GOOD["real"]}).to_report()
    assert alone["real_differences"] == report(GOOD).to_report()["real_differences"]
    rows = {(r["first"], r["second"]): r for r in alone["real_differences"]["stand"]}
    # By hand: a beats b in two of four starts; of four sign patterns, two are as extreme.
    row = rows["a", "b"]
    assert (row["difference"], row["p"]) == (0.5, 0.5)
    assert row["interval"][0] < 0.5 < row["interval"][1]


def test_a_world_without_spread_is_undefined_in_plain_json():
    whole = report(GOOD).to_report()
    copy = whole["agreement_of_other_worlds"]["copy"]["stand"]
    assert copy["pearson"] == "undefined"
    assert copy["pearson_interval"] == "undefined"
    # By hand: a (1.0) and b (0.5) are not put above anyone they beat, c beats nobody.
    assert copy["mmrv"] == pytest.approx((1.0 + 0.5 + 0.0) / 3)
    assert copy["mmrv_paper"] == 0.0
    assert whole["imagined_world"] == "model"
    json.dumps(whole, allow_nan=False)


ALL_ONE = {
    "real": {"a": "111111", "b": "100000", "c": "000000"},
    "dream": {"a": "111111", "b": "111111", "c": "111111"},
}


def test_a_world_that_calls_everything_a_success_is_not_perfect():
    whole = report(ALL_ONE).to_report()
    found = whole["agreement"]["stand"]
    assert found["mmrv"] == pytest.approx((1 + 1 / 6 + 0) / 3)
    assert found["mmrv_interval"][1] > 0.3
    size, step, optimistic, overrated, undefined = whole["comments"]["stand"]
    assert size == (
        "Agreement is computed over 6 of 6 starts, those completed in both worlds (real and dream) "
        "by every policy."
    )
    assert step == "One rollout changes a real success rate by 0.17 (N = 6 for each policy)."
    # By hand: (0 + 5/6 + 1) / 3 = 0.61.
    assert optimistic == (
        "On these starts dream is too optimistic: its success rates are 0.61 above the real ones "
        "on average."
    )
    assert "overrates 2 of 3 policies" in overrated
    assert "'c': 0.00 real, 1.00 imagined" in overrated
    assert undefined == (
        "Pearson is undefined: on these starts every policy has the same success rate (1.00) in "
        "dream, so there is nothing to correlate."
    )


def test_comments_on_strict_and_fair_worlds():
    strict = {"real": ALL_ONE["dream"], "dream": ALL_ONE["real"]}
    sentences = " ".join(report(strict).to_report()["comments"]["stand"])
    assert "On these starts dream is too pessimistic: its success rates are 0.61 below" in sentences
    assert "underrates 2 of 3 policies" in sentences
    assert "same success rate (1.00) in the real world" in sentences
    fair = report({"real": ALL_ONE["real"], "dream": ALL_ONE["real"]}).to_report()
    equal, correlation = fair["comments"]["stand"][2:]
    assert equal.endswith("success rates of dream are +0.00 from the real ones on average.")
    # Three policies: one of six assignments.
    assert correlation.endswith("rates that correlate at least as well: 0.17.")


def test_a_correlation_that_hangs_on_one_policy_is_named():
    worlds = {
        "real": {"a": "1111111111", "b": "1000000000", "c": "0000000000", "d": "1100000000"},
        "dream": {"a": "1111111111", "b": "0000000000", "c": "1100000000", "d": "0000000000"},
    }
    sentences = report(worlds).to_report()["comments"]["stand"]
    assert any(sentence.startswith("Without 'a', r would be -0.") for sentence in sentences)
    alone = report({"real": {"a": "10"}, "dream": {"a": "10"}}).to_report()
    assert alone["comments"]["stand"][-1].startswith("Pearson is undefined (1 policy): it needs")
    assert alone["agreement"]["stand"]["mmrv"] == "undefined (1 policy)"


TWO = {
    "real": {"a": "111110", "b": "100000"},
    "dream": {"a": "111100", "b": "110000"},
    "other": {"a": "111000", "b": "000000"},
}


def test_two_policies_are_no_correlation_anywhere_in_the_report(tmp_path, capsys):
    found = report(TWO).to_report()
    for agreement in (found["agreement"], found["agreement_of_other_worlds"]["other"]):
        for name in ("pearson", "spearman", "kendall", "pearson_chance"):
            assert agreement["stand"][name] == "undefined (2 policies)"
        assert agreement["stand"]["pearson_interval"] == "undefined"
    # By hand: |4/6 - 5/6| and |2/6 - 1/6|.
    assert found["agreement"]["stand"]["mean_absolute_error"] == pytest.approx(1 / 6)
    said = " ".join(found["comments"]["stand"])
    assert "Pearson is undefined (2 policies): it needs at least three" in said
    assert "Pearson's r is" not in said
    print_scores(found)
    line = next(one for one in capsys.readouterr().out.splitlines() if one.startswith("stand:"))
    assert line.startswith(
        "stand: Pearson undefined (2 policies), Kendall undefined (2 policies), MMRV 0.0"
    )
    assert "mean absolute error of the success rates 0.167 (95 % " in line
    (tile, beside) = tiles(found)
    assert (tile.name, tile.value) == ("worlds agree", "undefined (2 policies)")
    assert (beside.name, beside.value) == ("rates differ by", "0.167")
    assert "95 % interval 0." in beside.note
    write_report(found, ReportPictures(), tmp_path / "report.html")
    shown = (tmp_path / "report.html").read_text()
    assert "undefined (2 policies)" in shown
    assert "1.00 to 1.00" not in shown


def test_the_tile_of_three_policies_has_its_interval():
    found = report(GOOD).to_report()
    tile, error = tiles(found)
    stand = found["agreement"]["stand"]
    low, high = stand["pearson_interval"]
    assert tile.value == f"{np.corrcoef([1, 0.5, 0], [0.75, 0.75, 0.25])[0, 1]:.3f}"
    assert tile.note == f"Pearson, 1 of 1 tasks; 95 % interval {low:.2f} to {high:.2f}"
    # By hand: (0.25 + 0.25 + 0.25) / 3.
    assert error.value == "0.250"


def test_one_policy_that_never_ended_leaves_two():
    gone = [("model", "c", seed) for seed in range(4)]
    assert lost(report(GOOD), *gone)["agreement"]["stand"]["pearson"] == "undefined (2 policies)"


@pytest.mark.long
def test_two_policies_of_two_tasks_are_no_correlation_together():
    first = report({name: TWO[name] for name in ("real", "dream")}).scores
    second = tuple(replace(s, task="pour", success=not s.success) for s in first)
    whole = ClosedLoopReport(first + second, ("dream",), ("a", "b")).to_report()
    assert whole["agreement_of_all_tasks"]["pearson"] == "undefined (2 policies)"
    assert whole["agreement_of_all_tasks"]["mmrv"] == 0.0


def test_rubric_scores_of_all_rollouts_are_compared_by_hand():
    points = {"real": {"a": 1.0, "b": 0.5, "c": 0.0}, "model": {"a": 0.8, "b": 0.2, "c": 0.3}}
    scores = tuple(
        replace(
            s,
            rubric_score=points.get(s.world, {}).get(s.policy),
            cannot_tell=None if s.world == "real" else "too close",
        )
        for s in report(GOOD).scores
    )
    whole = ClosedLoopReport(scores, ("model", "copy"), ("a", "b", "c")).to_report()
    found = whole["rubrics"]["model"]["stand"]
    assert found["pearson"] == pytest.approx(np.corrcoef([1, 0.5, 0], [0.8, 0.2, 0.3])[0, 1])
    # b and c change places: each is wrong by the real difference, 0.5, and a by nothing.
    assert found["mmrv"] == pytest.approx(1 / 3)
    assert found["num_policies"] == 3
    assert whole["rubrics"]["copy"] == {}
    row = whole["policies"][1]
    assert (row["real_rubric"], row["imagined_rubric"]) == (0.5, 0.2)


def test_rates_that_differ_by_rounding_alone_are_equal():
    """Three starts of ten repeats: shares 0.1, 0.2, 0.3 in another order are the same rate."""
    scores = [
        RolloutScore("real", policy, "stand", k, f"start {k}", k < wins, 0.5)
        for policy, wins in (("a", 0), ("b", 1), ("c", 3))
        for k in range(3)
    ]
    scores += [
        RolloutScore("dream", policy, "stand", k, f"start {k}", n < wins, 0.5, repeat=n)
        for policy, successes in (("a", (1, 2, 3)), ("b", (3, 2, 1)), ("c", (1, 2, 3)))
        for k, wins in enumerate(successes)
        for n in range(10)
    ]
    whole = ClosedLoopReport(tuple(scores), ("dream",), ("a", "b", "c")).to_report()
    assert whole["agreement"]["stand"]["pearson"] == "undefined"
    assert "the same success rate (0.20) in dream" in whole["comments"]["stand"][-1]


def test_chance_below_its_resolution_is_said_in_words():
    # Eight policies in the same order: 1 of 8! = 40,320 pairings correlates as well.
    marks = {name: "1" * k + "0" * (8 - k) for k, name in enumerate("abcdefgh")}
    sentences = report({"real": marks, "dream": marks}).to_report()["comments"]["stand"]
    assert any("at least as well: fewer than one in a thousand" in s for s in sentences)


@pytest.mark.long
def test_agreement_of_all_tasks_correlates_all_policies_of_all_tasks():
    """Two tasks of different difficulty: their rates correlate at once, by hand."""
    easy, hard = report(GOOD).scores, []
    for world, policies in (
        ("real", {"a": "1000", "b": "0000", "c": "0000"}),
        ("model", {"a": "1100", "b": "0000", "c": "1000"}),
    ):
        for policy, marks in policies.items():
            hard += [
                RolloutScore(world, policy, "pour", k, f"pour {k}", mark == "1", float(mark))
                for k, mark in enumerate(marks)
            ]
    worlds = tuple(s for s in easy if s.world != "copy") + tuple(hard)
    whole = ClosedLoopReport(worlds, ("model",), ("a", "b", "c")).to_report()
    real, imagined = [1, 0.5, 0, 0.25, 0, 0], [0.75, 0.75, 0.25, 0.5, 0, 0.25]
    found = whole["agreement_of_all_tasks"]
    assert found["pearson"] == pytest.approx(np.corrcoef(real, imagined)[0, 1])
    low, high = found["pearson_interval"]
    assert low < found["pearson"] < high
    json.dumps(whole, allow_nan=False)
    # One task has none, nor have tasks that compare different policies: all of c's pouring failed.
    assert report(GOOD).to_report()["agreement_of_all_tasks"] == {}
    ended = tuple(s for s in worlds if (s.world, s.task, s.policy) != ("model", "pour", "c"))
    failures = tuple(
        RolloutFailure("model", "c", "pour", k, "Unavailable", "lost") for k in range(4)
    )
    other = ClosedLoopReport(ended, ("model",), ("a", "b", "c"), failures).to_report()
    assert other["agreement_of_all_tasks"] == {}


def undecided(whole: ClosedLoopReport, **starts: set[int]) -> ClosedLoopReport:
    """The report when the probe had abstained on these starts of each policy in the model."""
    scores = [
        replace(s, cannot_tell="too close")
        if s.world == "model" and s.seed in starts.get(s.policy, ())
        else s
        for s in whole.scores
    ]
    return replace(whole, scores=tuple(scores))


TEN = {
    "real": {"a": "1111111100", "b": "1111000000", "c": "1000000000", "d": "1010101010"},
    "model": {"a": "1111111000", "b": "1100000000", "c": "0000000011", "d": "1111100000"},
}


def test_rates_are_of_decided_rollouts():
    found = undecided(report(TEN), a={7, 8, 9}, c={9}, d={0, 1, 2, 3, 4}).to_report()
    a, b, c, d = found["policies"]
    assert [row["imagined_undecided"] for row in (a, b, c, d)] == [3, 0, 1, 5]
    # Seven of seven, two of ten, one of nine, none of five; real ones are all decided.
    assert [row["imagined"] for row in (a, b, c, d)] == pytest.approx([1, 0.2, 1 / 9, 0])
    expected = binomtest(7, 7).proportion_ci(method="wilson")
    assert a["imagined_interval"] == pytest.approx([expected.low, expected.high])
    assert [row["real"] for row in (a, b, c, d)] == pytest.approx([0.8, 0.4, 0.1, 0.5])
    assert [row["imagined_comparable"] for row in (a, b, c, d)] == [True, True, True, False]
    # Fewer than 60 % of d are decided; the others are compared by their decided rollouts.
    agreement = found["agreement"]["stand"]
    assert agreement["not_comparable"] == ["d"]
    assert (agreement["num_policies"], agreement["num_starts"]) == (3, 10)
    real, imagined = [0.8, 0.4, 0.1], [1, 0.2, 1 / 9]
    assert agreement["pearson"] == pytest.approx(np.corrcoef(real, imagined)[0, 1])
    assert agreement["bias"] == pytest.approx(np.mean(imagined) - np.mean(real))
    pair = agreement["differences"]["imagined"][0]
    # a and b on the seven starts that both decided.
    assert (pair["first"], pair["second"]) == ("a", "b")
    assert pair["difference"] == pytest.approx(1 - 2 / 7)
    first, second, compared, *_ = found["comments"]["stand"]
    assert first.startswith("Of 9 of 40 rollouts in model it cannot be told")
    assert second.endswith("60% of the rollouts in model were decided: 'd'.")
    assert compared.startswith("Agreement is computed over 10 of 10 starts")
    json.dumps(found, allow_nan=False)


@pytest.mark.long
def test_undecided_rollouts_stand_beside_every_rate(tmp_path, capsys):
    whole = undecided(report(TEN), a={7, 8, 9}, d={0, 1, 2, 3, 4})
    print_scores(whole.to_report())
    lines = {line.split()[1]: line for line in capsys.readouterr().out.splitlines()[1:5]}
    assert lines["a"].endswith("1.00 of 7  3 of 10 cannot tell")
    assert lines["b"].endswith("0.200 of 10")
    assert lines["d"].endswith("0.0 of 5  5 of 10 cannot tell, not comparable")
    write_report(whole.to_report(), ReportPictures(), tmp_path / "report.html")
    shown = (tmp_path / "report.html").read_text()
    assert "3 of 10 cannot tell</span>" in shown
    assert "5 of 10 cannot tell, not comparable</span>" in shown
    # Policies that are not comparable have no point beside the others.
    picture = shown[shown.index('<rect class="paper"') :].split("</svg>")[0]
    assert [f">{name}</text>" in picture for name in "abcd"] == [True, True, True, False]
    rows = latex_tables(whole).splitlines()
    assert (
        r" & model & 1.000 {\scriptsize [0.65, 1.00]} {\scriptsize 3 of 10 cannot tell} \\" in rows
    )


def test_a_policy_of_which_nothing_is_decided_has_no_rate():
    found = undecided(report(TEN), **{name: set(range(10)) for name in "abcd"}).to_report()
    assert [row["imagined"] for row in found["policies"]] == ["undefined"] * 4
    assert found["policies"][0]["imagined_undecided"] == 10
    assert found["agreement"]["stand"]["pearson"] == "undefined"
    assert found["agreement"]["stand"]["not_comparable"] == list("abcd")
    assert found["comments"]["stand"][-1] == "No policy is left to compare."
    json.dumps(found, allow_nan=False)


def test_a_policy_that_decided_none_of_the_common_starts_is_left_out():
    # Of c only starts 0 and 1 ended in the real world, and these are not decided.
    whole = undecided(report(TEN), c={0, 1})
    found = lost(whole, *(("real", "c", seed) for seed in range(2, 10)))
    assert list(found["agreement"]["stand"]["rates"]) == ["a", "b", "d"]


@pytest.mark.long
def test_probe_is_judged_on_real_rollouts():
    assert report(GOOD).to_report()["probe_accuracy_on_real"] == 1.0
    # From one half on, a probability says success.
    two = report({"real": {"a": "10"}})
    even = replace(two, scores=tuple(replace(score, probability=0.5) for score in two.scores))
    assert even.probe_accuracy() == 0.5
    sure = replace(two, scores=(even.scores[0], two.scores[1]))
    assert sure.probe_accuracy() == 1.0


def test_different_starts_are_not_compared():
    whole = report(GOOD)
    moved = [replace(s, start_digest="another") if s.policy == "c" else s for s in whole.scores]
    with pytest.raises(InvalidInputError, match="different starts"):
        ClosedLoopReport(tuple(moved), whole.imagined_worlds, whole.policies).agreement("model")


@pytest.mark.long
def test_failed_rollouts_are_missing_not_failures_of_the_policy():
    whole = report(GOOD)

    def gone(score):  # Policy b fails from start 1 in the model, policy c from every start there.
        return score.world == "model" and (
            (score.policy, score.seed) == ("b", 1) or score.policy == "c"
        )

    failures = tuple(
        RolloutFailure(s.world, s.policy, s.task, s.seed, "UnavailableError", "gone")
        for s in whole.scores
        if gone(s)
    )
    kept = tuple(s for s in whole.scores if not gone(s))
    found = ClosedLoopReport(kept, whole.imagined_worlds, whole.policies, failures).to_report()
    a, b, c = found["policies"]
    assert (a["imagined"], a["imagined_rollouts"], a["imagined_failed"]) == (0.75, 4, 0)
    assert (b["imagined"], b["imagined_rollouts"], b["imagined_failed"]) == (2 / 3, 3, 1)
    assert (c["imagined"], c["imagined_rollouts"], c["imagined_failed"]) == ("undefined", 0, 4)
    # Left are policies a and b from starts 0, 2 and 3: real 1 and 1/3, imagined 2/3 and 2/3.
    agreement = found["agreement"]["stand"]
    assert (agreement["num_policies"], agreement["num_starts"]) == (2, 3)
    assert agreement["bias"] == pytest.approx((2 / 3 + 2 / 3 - 1 - 1 / 3) / 2)
    assert found["num_rollouts"] == 36
    assert len(found["failures"]) == 5
    json.dumps(found, allow_nan=False)


def lost(whole: ClosedLoopReport, *keys: tuple[str, str, int]) -> dict[str, Any]:
    """The report when these rollouts (world, policy, seed) had failed."""
    kept = [s for s in whole.scores if (s.world, s.policy, s.seed) not in keys]
    failures = [RolloutFailure(*key[:2], "stand", key[2], "DeviceError", "gone") for key in keys]
    return ClosedLoopReport(
        tuple(kept), whole.imagined_worlds, whole.policies, tuple(failures)
    ).to_report()


def test_one_policy_that_fails_narrows_the_agreement_and_the_comments_say_so():
    ended = {"a": "1" * 10 + "0" * 10, "b": "1" * 5 + "0" * 15, "c": "1" * 20}
    dream = {"a": "1" * 10 + "0" * 10, "b": "1" * 20, "c": "1" * 20}
    whole = report({"real": ended, "dream": dream})
    found = lost(whole, *(("real", "c", seed) for seed in range(1, 20)))
    size, step, mean, gap, undefined = found["comments"]["stand"]
    # Only start 0 is left, from which every policy succeeds in both worlds.
    assert size.startswith("Agreement is computed over 1 of 20 starts, those completed in both")
    assert step == (
        "One rollout changes a real success rate by 0.05 (N = 20: 'a', 'b') or 1.00 (N = 1: 'c')."
    )
    assert mean.startswith("On these starts the success rates of dream are +0.00 from the real")
    assert gap.startswith("Over all completed rollouts, dream overrates 1 of 3 policies")
    assert "'b': 0.25 real, 1.00 imagined" in gap
    assert "on these starts every policy has the same success rate (1.00) in the real" in undefined
    assert found["agreement"]["stand"]["rates"] == {
        policy: {"real": 1.0, "imagined": 1.0} for policy in "abc"
    }


@pytest.mark.long
def test_a_policy_without_a_start_that_ended_twice_is_named_as_left_out():
    gone = [("model", "c", seed) for seed in range(4)]
    found = lost(report(GOOD), *gone)
    assert found["comments"]["stand"][0] == (
        "Agreement is computed over 4 of 4 starts, those completed in both worlds (real and model) "
        "by every policy except 'c', which completed none."
    )
    assert list(found["agreement"]["stand"]["rates"]) == ["a", "b"]


def test_policies_that_ended_from_different_starts_are_not_compared():
    pair = report({"real": {"a": "10", "b": "01"}, "dream": {"a": "10", "b": "01"}})
    found = lost(pair, ("dream", "a", 0), ("dream", "b", 1))
    assert found["comments"]["stand"] == [
        "No start was completed in both worlds (real and dream) by every policy: "
        "nothing to compare."
    ]


def test_without_a_common_start_there_is_no_agreement():
    whole = report(GOOD)
    failures = tuple(
        RolloutFailure(s.world, s.policy, s.task, s.seed, "UnavailableError", "gone")
        for s in whole.scores
    )
    found = ClosedLoopReport((), whole.imagined_worlds, whole.policies, failures).to_report()
    assert found["agreement"]["stand"]["pearson"] == "undefined"
    assert found["agreement"]["stand"]["num_starts"] == 0
    missing = set(report(GOOD).agreement("model")["stand"]) - set(found["agreement"]["stand"])
    assert {"pearson_interval", "mmrv_interval", "bias_interval", "pearson_chance"} <= missing
    assert found["probe_accuracy_on_real"] == "undefined"


def test_without_an_imagined_world_there_are_real_rates_only(tmp_path):
    found = report({"real": GOOD["real"]}).to_report()
    assert [row["real"] for row in found["policies"]] == [1.0, 0.5, 0.0]
    assert "imagined" not in found["policies"][0]
    assert found["agreement"] == found["comments"] == {}
    assert found["imagined_world"] is None
    write_report(found, ReportPictures(), tmp_path / "report.html")
    shown = (tmp_path / "report.html").read_text()
    assert "0.50" in shown
    assert '<th class="number">imagined' not in shown
