"""Rubrics and agreement of raters against the paper, published examples and hand calculations."""

import json
from pathlib import Path

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, UnknownNameError
from services.evaluation.rating.rating_report import (
    intraclass_correlation,
    krippendorff_alpha,
    rater_biases,
)
from services.evaluation.rating.rubrics import Rubric, read_rubrics, rubric_of
from services.twin.tasks import TASK_NAMES, get_task

nan = np.nan
RUBRICS = read_rubrics()
# Krippendorff, "Computing Krippendorff's Alpha-Reliability" (2011), example C: 4 observers of 12
# units.
KRIPPENDORFF = np.array([
    [1, 2, 3, 3, 2, 1, 4, 1, 2, nan, nan, nan],
    [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, nan, 3],
    [nan, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, nan],
    [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, nan],
]).T  # fmt: skip
# Shrout and Fleiss, "Intraclass Correlations" (1979), table 2: 6 targets, 4 judges.
SHROUT_FLEISS = np.array([
    [9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7],
]) * 1.0  # fmt: skip


def test_alpha_of_the_published_example():
    assert krippendorff_alpha(KRIPPENDORFF, level="nominal") == pytest.approx(0.743, abs=5e-4)
    assert krippendorff_alpha(KRIPPENDORFF, level="interval") == pytest.approx(0.849, abs=5e-4)


def test_alpha_of_equal_ratings_is_undefined():
    assert np.isnan(krippendorff_alpha(np.ones((4, 3)), level="nominal"))
    assert np.isnan(krippendorff_alpha(np.array([[1, nan], [nan, 0]]), level="interval"))
    assert krippendorff_alpha(np.array([[1.0, 1.0], [0.0, 0.0]]), level="nominal") == 1.0
    # The mean of such scores is not quite the score.
    for same in (np.full((7, 3), 0.1), np.full((10, 2), 0.7)):
        assert np.isnan(krippendorff_alpha(same, level="interval"))
        assert np.isnan(intraclass_correlation(same))


def test_alpha_with_absent_raters_by_hand():
    # Three zeros and four ones: 7² - 3² - 4² = 24 unequal pairs of 42; one rollout disagrees.
    ratings = np.array([[0, 1, nan], [0, 0, nan], [1, 1, 1]])
    assert krippendorff_alpha(ratings, level="nominal") == pytest.approx(1 - 2 / (24 / 6))


def test_alpha_of_chance_is_zero():
    ratings = np.random.default_rng(0).integers(0, 2, (4000, 3)) * 1.0
    assert krippendorff_alpha(ratings, level="nominal") == pytest.approx(0, abs=0.02)


def test_intraclass_correlation_of_the_published_example():
    assert intraclass_correlation(SHROUT_FLEISS) == pytest.approx(0.62, abs=5e-3)
    more = np.concatenate([SHROUT_FLEISS, [[5, nan, 5, 5]]])
    assert intraclass_correlation(more) == intraclass_correlation(SHROUT_FLEISS)
    assert np.isnan(intraclass_correlation(SHROUT_FLEISS[:1]))


def test_biases_of_raters_by_hand():
    ratings = np.array([[1.0, 0.5, 0.5], [1.0, 0.5, nan], [nan, nan, 0.2]])
    strict, *_ = rater_biases(["a", "b", "c"], ratings, np.random.default_rng(0))
    assert (strict.rater, strict.bias, strict.num_rollouts) == ("a", pytest.approx(0.5), 2)
    assert strict.interval.low == pytest.approx(0.5)
    # One rollout does not say how far the next one would be from it.
    assert rater_biases(["a", "b"], ratings[:1, :2], np.random.default_rng(0)) == []


def test_points_are_those_of_the_paper():
    # "World Models as Policy Evaluators": shoes 4, bowls 2, phone 2, bottle 1; penalty 0.5.
    expected = {"place_shoes": 4, "stack_three_bowls": 2, "place_phone": 2, "stand_bottle": 1}
    assert {task: rubric_of(task, RUBRICS).max_points for task in expected} == expected
    assert {rubric.penalty for rubric in RUBRICS.values()} == {0.5}


def test_points_agree_with_the_table_of_the_paper():
    path = Path(__file__).parents[3].parent / "shared" / "paper_tables.json"
    if not path.exists():
        pytest.skip(f"{path} is not on this machine")
    table = json.loads(path.read_text())
    names = {"Stack Bowls": "stack_three_bowls"}
    for title, points in table["rubric_max_points"].items():
        assert (
            rubric_of(names.get(title, title.lower().replace(" ", "_")), RUBRICS).max_points
            == points
        )
    assert table["imagined_penalty_points"] == 0.5


@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_twin_scores_all_its_tasks(task):
    rubric, milestones = rubric_of(task, RUBRICS), get_task(task).milestones
    assert {one.milestone for one in rubric.criteria} <= set(milestones)
    assert rubric.score_by_milestones(dict.fromkeys(milestones, 0.0)) == 0
    assert rubric.score_by_milestones(dict.fromkeys(milestones, 1.0)) == 1


def test_scores_by_hand():
    rubric = rubric_of("place_shoes", RUBRICS)
    names = [one.name for one in rubric.criteria]
    holds = dict(zip(names, [True, False, True, False], strict=True))
    assert rubric.score(holds) == 0.5
    assert rubric.score(holds, is_inconsistent=True) == 0.375
    # Both placed without both picked up gives nothing for it, nor a penalty below zero.
    assert rubric.score(dict(zip(names, [False, False, True, True], strict=True))) == 0
    assert rubric.score(dict.fromkeys(names, False), is_inconsistent=True) == 0


def test_probable_milestones_score_by_hand():
    rubric = rubric_of("place_shoes", RUBRICS)
    reached = {"one_lifted": 0.9, "both_lifted": 0.6, "one_placed": 0.8, "both_placed": 0.7}
    # Both placed is no more probable than both picked up, 0.6: (0.9 + 0.6 + 0.8 + 0.6) / 4.
    assert rubric.score_by_milestones(reached) == pytest.approx(0.725)
    assert rubric.score_by_milestones({**reached, "touched": 1.0}) == pytest.approx(0.725)
    assert rubric.score_by_milestones(dict.fromkeys(reached, 1.0)) == 1
    del reached["one_placed"]
    assert rubric.score_by_milestones(reached) is None
    by_people_alone = rubric_of("stack_three_bowls", RUBRICS)
    assert by_people_alone.score_by_milestones({"nested": 1.0}) is None


def test_marks_that_do_not_fit_are_refused():
    rubric = rubric_of("place_phone", RUBRICS)
    with pytest.raises(UnknownNameError, match="'flew'"):
        rubric.score({"picked_up": True, "placed": True, "flew": True})
    with pytest.raises(InvalidInputError, match="no mark for placed"):
        rubric.score({"picked_up": True})
    with pytest.raises(UnknownNameError, match="place_phone"):
        rubric_of("juggle", RUBRICS)


@pytest.mark.parametrize(
    ("criteria", "message"),
    [
        ("[]", "at least 1"),
        ('[{name = "a", points = 0, description = "x"}]', "criteria.0.points"),
        ('[{name = "a", points = 1, description = "x", requires = ["b"]}]', "requires 'b'"),
        ('[{name = "a", points = 1, description = "x", colour = "red"}]', "criteria.0.colour"),
    ],
)
def test_rubrics_that_make_no_sense_are_refused(tmp_path, criteria, message):
    path = tmp_path / "rubrics.toml"
    path.write_text(f"[juggle]\ncriteria = {criteria}\n")
    with pytest.raises(InvalidInputError, match=message):
        read_rubrics(path)
    path.write_text("[juggle")
    with pytest.raises(InvalidInputError, match="cannot be read"):
        read_rubrics(path)


def test_a_criterion_given_twice_is_refused():
    twice = [{"name": "a", "points": 1, "description": "x"}] * 2
    with pytest.raises(ValueError, match="given twice"):
        Rubric.model_validate({"criteria": twice})
