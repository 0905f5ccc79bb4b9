"""Milestones of every task: reached in order by a success, the last one exactly by a success."""

import pytest

from dextouch.episodes import EpisodeStore
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import TASK_NAMES, get_task

SEED = 3


# Tasks that share their code with another one are recorded by the slow run only.
ALIKE = ("lift_empty_can", "move_can_right")


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=[pytest.mark.slow] if name in ALIKE else []) for name in TASK_NAMES
    ],
)
def stage(request):
    return Stage(request.param, "robot", TwinSettings())


@pytest.mark.long
def test_a_success_reaches_all_milestones_in_order(stage, tmp_path):
    episode = record(stage, SEED, TakeOptions(images=()))
    times_s = episode.attributes.event_times_s
    assert episode.attributes.success is True
    assert tuple(times_s) == stage.task.milestones
    assert list(times_s.values()) == sorted(times_s.values())
    assert 0 < times_s["touched"] < times_s[stage.task.milestones[-1]] < 81 / 15
    store = EpisodeStore(tmp_path)
    stored = store.open(write_episode(store, episode)).attributes
    assert stored.event_times_s == times_s
    assert len(stored.object_boxes_m) == len(stored.object_names)


@pytest.mark.slow
def test_a_miss_neither_touches_nor_succeeds(stage):
    episode = record(stage, SEED, TakeOptions(miss=True, images=()))
    assert episode.attributes.success is False
    assert stage.task.milestones[-1] not in episode.attributes.event_times_s


@pytest.mark.slow
def test_a_take_that_holds_still_reaches_nothing(stage):
    frozen = record(stage, SEED, TakeOptions(images=(), frozen_from_step=0))
    assert frozen.attributes.event_times_s == {}


@pytest.mark.long
def test_the_last_milestone_is_success(stage):
    stage.start(stage.plan(SEED))
    reached = stage.task.reached(stage.simulation)
    assert len(reached) == len(stage.task.milestones) == len(set(stage.task.milestones))
    assert reached[-1] is stage.task.succeeded(stage.simulation) is False


@pytest.mark.parametrize(
    ("task", "poses", "expected"),
    [
        # Standing on its foot, lying, and standing in the air.
        ("stand_bottle", [[0, 0, 0.1148, 1, 0, 0, 0]], (False, False, True, True, True)),
        ("stand_bottle", [[0, 0, 0.034, 0.5**0.5, 0.5**0.5, 0, 0]], (False,) * 5),
        ("stand_bottle", [[0, 0, 0.3, 1, 0, 0, 0]], (False, False, True, False, False)),
        # One in the other, beside it, and 16 mm off in the air above it.
        (
            "stack_bowls",
            [[0, 0, 0.0145, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0]],
            (False, False, False, True, True),
        ),
        ("stack_bowls", [[0.13, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0]], (False,) * 5),
        ("stack_bowls", [[0.016, 0, 0.2, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0]], (False,) * 5),
    ],
)
def test_states_made_by_hand_are_judged_rightly(task, poses, expected, hand_made):
    assert get_task(task).reached(hand_made(task, poses)) == expected
