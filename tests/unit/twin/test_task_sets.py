"""Sets of tasks: which tasks each has, that no task is in two of them, and names of both kinds."""

import pytest

from dextouch.errors import UnknownNameError
from services.twin.tasks import EVALUATED, TASK_NAMES, TASK_SETS, named_tasks


def test_every_task_is_in_exactly_one_of_the_three_sets():
    disjoint = ("downstream", "robot-pretraining", "human-pretraining")
    members = [task for name in disjoint for task in TASK_SETS[name]]
    assert sorted(members) == sorted(TASK_NAMES)


def test_the_default_is_what_the_checkpoints_of_the_package_know():
    known = "stand_bottle stack_bowls insert_peg place_shoes place_phone open_drawer"
    assert TASK_SETS["evaluated"] == EVALUATED == tuple(known.split())
    assert set(TASK_SETS["downstream"]) <= set(EVALUATED)


def test_names_of_tasks_and_sets_may_be_mixed():
    assert named_tasks(("open_drawer", "stack_bowls")) == ("open_drawer", "stack_bowls")
    found = named_tasks(("stack_bowls", "downstream", "regrasp_can"))
    assert found == ("stack_bowls", "place_shoes", "place_phone", "stand_bottle", "regrasp_can")
    assert named_tasks(()) == ()


@pytest.mark.parametrize("listed", ["robot-pretraining", "regrasp_can"])
def test_an_unknown_name_lists_tasks_and_sets(listed):
    with pytest.raises(UnknownNameError, match=listed):
        named_tasks(("stack_bowls", "juggling"))
