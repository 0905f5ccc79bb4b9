"""Marks that are never lost, and the order in which raters see rollouts."""

import sqlite3
from collections import Counter
from itertools import pairwise

import pytest
from pydantic import ValidationError

from dextouch.errors import ConflictError, NotFoundError, StorageError
from services.evaluation.rating.marks import DECIDING, FIRST, REPEAT, Mark, MarkLog, by_people, vote
from services.evaluation.rating.rating_queue import Assignment, RatedRollout, RatingQueue, token_of
from services.evaluation.rating.rating_report import rating_report
from services.evaluation.rating.rubrics import read_rubrics

IDS = [f"rollout-{number}" for number in range(12)]


def rollouts(ids=IDS):
    return [
        RatedRollout(token_of(one), one, "stand_bottle", "Stand it up.", 40, 15.0) for one in ids
    ]


def mark(rater, episode_id, *, standing=True, **changes):
    fields = {"rater": rater, "episode_id": episode_id, "holds": {"standing": standing}}
    return Mark.model_validate(fields | changes)


@pytest.fixture
def log(tmp_path):
    return MarkLog(tmp_path / "deep" / "ratings.sqlite")


def rate_all(queue, log, rater, *, standing=lambda _: True):
    order = []
    while (assigned := queue.next(rater)) is not None:
        name = assigned.rollout.episode_id
        order.append((name, assigned.presentation))
        log.add(mark(rater, name, standing=standing(name), presentation=assigned.presentation))
    return order


def test_a_correction_counts_and_the_first_mark_stays(log):
    log.add(mark("ada", "rollout-1"))
    number = log.add(mark("ada", "rollout-1", standing=False))
    assert [one.mark.holds["standing"] for one in log.history()] == [True, False]
    (latest,) = MarkLog(log.path).latest()
    assert (latest.number, latest.mark.holds) == (number, {"standing": False})


@pytest.mark.parametrize("change", ["UPDATE marks SET rater = 'eve'", "DELETE FROM marks"])
def test_marks_cannot_be_changed(log, change):
    log.add(mark("ada", "rollout-1"))
    connection = sqlite3.connect(log.path)
    with pytest.raises(sqlite3.IntegrityError, match="never"):
        connection.execute(change)
    connection.close()
    assert len(log.history()) == 1


def test_a_file_that_is_no_database_is_refused(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("not a database, but long enough to be looked at as one")
    with pytest.raises(StorageError, match=r"notes\.txt: cannot be opened"):
        MarkLog(path)


def test_a_mark_judges_or_does_not():
    assert mark("ada", "rollout-1", holds={}, cannot_judge=True).cannot_judge
    for fields in ({"holds": {}}, {"cannot_judge": True}):
        with pytest.raises(ValidationError, match="every criterion, or cannot_judge"):
            mark("ada", "rollout-1", **fields)
    with pytest.raises(ValidationError, match="rater"):
        mark("../ada", "rollout-1")


def test_every_rollout_gets_its_raters_and_each_rater_an_order_of_their_own(log):
    queue = RatingQueue(rollouts(), log, raters_per_rollout=2, repeat_share=0.0)
    orders = {rater: rate_all(queue, log, rater) for rater in ("ada", "bob", "cy")}
    assert Counter(one.mark.episode_id for one in log.history()) == dict.fromkeys(IDS, 2)
    assert [len(order) for order in orders.values()] == [12, 12, 0]
    first, second = ([name for name, _ in orders[rater]] for rater in ("ada", "bob"))
    assert sorted(first) == sorted(second) == sorted(IDS)
    assert first != second != IDS


def test_raters_in_turns_keep_rollouts_balanced(log):
    queue = RatingQueue(rollouts(), log, raters_per_rollout=2, repeat_share=0.0)
    for _ in range(4):
        for rater in ("ada", "bob", "cy"):
            log.add(mark(rater, queue.next(rater).rollout.episode_id))
    counts = Counter(one.mark.episode_id for one in log.history())
    assert set(counts.values()) == {1}
    assert len(counts) == 12


def test_asking_twice_gives_the_same_rollout(log):
    queue = RatingQueue(rollouts(), log)
    assert queue.next("ada") == queue.next("ada")
    with pytest.raises(NotFoundError, match="rollout"):
        queue.rollout("0" * 20)


def test_some_rollouts_come_back_after_a_while(log):
    many = [f"rollout-{number}" for number in range(40)]
    queue = RatingQueue(rollouts(many), log, raters_per_rollout=1, repeat_share=0.1)
    order = rate_all(queue, log, "ada")
    names = [name for name, _ in order]
    repeats = [(index, name) for index, (name, shown) in enumerate(order) if shown == REPEAT]
    assert len(repeats) == 4
    assert len(order) == 44
    for index, name in repeats:
        assert index - names.index(name) > 10
        assert order[names.index(name)] == (name, FIRST)


def test_marks_of_other_rollouts_in_the_same_file_are_no_progress(log):
    names = [[f"{study}-{number}" for number in range(40)] for study in ("first", "second")]
    first, second = (
        RatingQueue(rollouts(ids), log, raters_per_rollout=1, repeat_share=share)
        for ids, share in zip(names, (0.0, 0.1), strict=True)
    )
    assert len(rate_all(first, log, "ada")) == 40
    assert (second.next("ada").num_done, second.next("ada").num_open) == (0, 40)
    repeats = [index for index, (_, shown) in enumerate(rate_all(second, log, "ada")) if shown == 2]
    assert len(repeats) == 4
    assert min(b - a for a, b in pairwise(repeats)) >= 10


def test_one_rated_rollout_has_no_interval(log):
    for rater in ("ada", "bob"):
        log.add(mark(rater, IDS[0], standing=rater == "ada"))
    tasks = dict.fromkeys(IDS, "stand_bottle")
    found = rating_report(log.latest(), tasks, read_rubrics(), {})["tasks"]["stand_bottle"]
    assert (found["score"], found["score_interval"], found["raters"]) == (0.5, "undefined", [])


def test_automatic_marks_do_not_take_a_person_s_place(log):
    for name in IDS:
        log.add(mark("probe", name, kind="auto"))
    queue = RatingQueue(rollouts(), log, raters_per_rollout=1, repeat_share=0.0)
    assert len(rate_all(queue, log, "ada")) == 12


def test_a_program_with_the_name_of_a_person_corrects_nothing_of_theirs(log):
    log.add(mark("ada", IDS[0], standing=True))
    log.add(mark("ada", IDS[0], standing=False, kind="auto"))
    tasks = {IDS[0]: "stand_bottle"}
    (row,) = rating_report(log.latest(), tasks, read_rubrics(), {})["rollouts"]
    assert (row["human_scores"], row["auto_scores"]) == ([1.0], [0.0])


def test_a_program_sees_a_tie_of_people_once(log):
    for rater, stands in (("ada", True), ("bob", False)):
        for name in IDS[:3]:
            log.add(mark(rater, name, standing=stands))
    queue = RatingQueue(rollouts(IDS[:3]), log, raters_per_rollout=2, repeat_share=0.0)
    shown = []
    while (assigned := queue.next("probe")) is not None and len(shown) < 6:
        shown.append(assigned.rollout.episode_id)
        log.add(mark("probe", shown[-1], kind="auto", presentation=assigned.presentation))
    assert sorted(shown) == IDS[:3]


def test_the_report_by_hand(log):
    for rater in ("ada", "bob"):
        for name in IDS[:4]:
            stands = name in IDS[:2] and not (rater == "bob" and name == IDS[1])
            log.add(mark(rater, name, standing=stands))
    log.add(mark("ada", IDS[0], standing=False, presentation=REPEAT))
    log.add(mark("ada", IDS[5], holds={}, cannot_judge=True))
    log.add(mark("probe", IDS[1], kind="auto"))
    log.add(mark("ada", "of-another-store"))
    tasks = dict.fromkeys(IDS, "stand_bottle")
    found = rating_report(log.latest(), tasks, read_rubrics(), {IDS[1]: 1.0, IDS[2]: 0.0})
    scores = {row["episode_id"]: row["score"] for row in found["rollouts"]}
    assert scores == {IDS[0]: 1.0, IDS[1]: 0.5, IDS[2]: 0.0, IDS[3]: 0.0}
    assert found["rollouts"][1]["auto_scores"] == [1.0]
    assert [row["state_score"] for row in found["rollouts"]] == ["undefined", 1.0, 0.0, "undefined"]
    assert found["cannot_judge"] == 1
    task = found["tasks"]["stand_bottle"]
    assert (task["score"], task["num_raters"], task["num_rollouts"]) == (0.375, 2, 4)
    # 8 ratings, 3 of them 1. Observed: one of four pairs differs, 2 ordered pairs of 8; expected:
    # 2 · 3 · 5 of 8 · 7 ordered pairs. Alpha = 1 - (2 / 8) / (30 / 56).
    assert task["alpha_by_criterion"]["standing"] == pytest.approx(1 - (2 / 8) / (30 / 56))
    # The second rollout lacks 0.5, the third nothing.
    assert task["less_state_score"] == -0.25
    assert task["repeats"] == {"num": 1, "same_score": 0.0}
    assert {row["rater"]: row["bias"] for row in task["raters"]} == {"ada": 0.25, "bob": -0.25}
    assert "agree too little" in task["comment"]


def test_two_raters_who_differ_are_decided_by_a_third_who_is_neither(log):
    queue = RatingQueue(rollouts(IDS[:4]), log, raters_per_rollout=2, repeat_share=0.0)
    rate_all(queue, log, "ada")
    rate_all(queue, log, "bob", standing=lambda name: name in IDS[:2])
    assert queue.next("ada") is None
    assert queue.next("bob") is None
    # Only where they differ, and said to be what it is.
    decided = rate_all(queue, log, "carl", standing=lambda name: name == IDS[2])
    assert sorted(decided) == [(IDS[2], DECIDING), (IDS[3], DECIDING)]
    assert queue.next("dora") is None
    found = rating_report(log.latest(), dict.fromkeys(IDS, "stand_bottle"), read_rubrics(), {})
    rows = {row["episode_id"]: row["decided_score"] for row in found["rollouts"]}
    assert rows == {IDS[0]: 1.0, IDS[1]: 1.0, IDS[2]: 1.0, IDS[3]: 0.0}
    task = found["tasks"]["stand_bottle"]
    assert task["conflicts"] == {"open": 0, "settled": 2}
    # Whoever decides sees only the hard ones, so that alpha is that of the first two alone:
    # 1, 1, 1, 1 against 1, 1, 0, 0, by `krippendorff` 0.9.0.
    assert task["num_raters"] == 2
    assert task["alpha_by_criterion"]["standing"] == pytest.approx(-1 / 6)


def test_a_tie_on_whether_it_can_be_judged_is_decided_too(log):
    queue = RatingQueue(rollouts(IDS[:1]), log, raters_per_rollout=2, repeat_share=0.0)
    log.add(mark("ada", IDS[0]))
    log.add(mark("bob", IDS[0], holds={}, cannot_judge=True))
    assert queue.next("carl").presentation == DECIDING
    log.add(mark("carl", IDS[0], holds={}, cannot_judge=True, presentation=DECIDING))
    assert queue.next("dora") is None


def test_nobody_decides_without_a_tie_or_twice(log):
    queue = RatingQueue(rollouts(IDS[:2]), log, raters_per_rollout=2)
    for rater, stands in (("ada", True), ("bob", False)):
        log.add(mark(rater, IDS[0], standing=stands))
        log.add(mark(rater, IDS[1]))
    queue.check(mark("carl", IDS[0], presentation=DECIDING))
    for rater, name in (("ada", IDS[0]), ("carl", IDS[1])):
        with pytest.raises(ConflictError, match="other raters are complete and tied"):
            queue.check(mark(rater, name, presentation=DECIDING))
    more = RatingQueue(rollouts(IDS[:2]), log, raters_per_rollout=3)
    with pytest.raises(ConflictError, match="other raters are complete and tied"):
        more.check(mark("carl", IDS[0], presentation=DECIDING))
    # The work of two who decide at the same time is kept.
    log.add(mark("carl", IDS[0], presentation=DECIDING))
    queue.check(mark("dora", IDS[0], presentation=DECIDING))
    with pytest.raises(ConflictError, match="got presentation 1"):
        queue.check(mark("carl", IDS[0]))
    queue.check(mark("carl", IDS[1]))
    # Marks of before that was refused: one rater, one vote.
    log.add(mark("carl", IDS[0]))
    latest = (stored.mark for stored in log.latest())
    assert [one.rater for one in by_people(latest)[IDS[0]]] == ["ada", "bob", "carl"]


def test_a_deciding_mark_is_not_repeated(log):
    queue = RatingQueue(rollouts(), log, raters_per_rollout=2, repeat_share=0.5)
    for number, name in enumerate(IDS):
        log.add(mark("carl", name, presentation=DECIDING if number < 2 else FIRST))
    assert queue.next("carl") is None
    log.add(mark("carl", "of-another-store"))
    assert queue.next("carl") == Assignment(queue.rollout(token_of(IDS[2])), REPEAT, 12, 0)


def test_a_tie_is_a_conflict_once_its_raters_are_complete(log):
    for rater, stands in (("ada", True), ("bob", False)):
        log.add(mark(rater, IDS[0], standing=stands))
    known, rubrics, found = log.latest(), read_rubrics(), []
    for num in (2, 3):
        tasks = {IDS[0]: "stand_bottle"}
        report = rating_report(known, tasks, rubrics, {}, raters_per_rollout=num)
        found.append(report["tasks"]["stand_bottle"]["conflicts"]["open"])
    assert found == [1, 0]


def test_votes_count_each_criterion_by_itself():
    def judged(met):
        return mark("ada", IDS[0], holds={"a": "a" in met, "b": "b" in met})

    assert vote([judged("a"), judged("ab")]).tied == ("b",)
    three = vote([judged("a"), judged("ab"), judged("b")])
    assert (three.holds, three.tied) == ({"a": True, "b": True}, ())
    assert vote([judged("a")]).tied == ()
