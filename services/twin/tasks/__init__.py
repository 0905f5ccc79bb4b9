"""Tasks of the twin, each with objects, placement, demonstrator and success check."""

from collections.abc import Iterable
from typing import Final

from dextouch.errors import UnknownNameError
from services.twin.names import EVALUATED, TASK_NAMES, TASK_SETS
from services.twin.tasks.cans import CAN_TASKS, RegraspCan
from services.twin.tasks.insert_peg import InsertPeg
from services.twin.tasks.lift_box import LiftBox
from services.twin.tasks.open_drawer import OpenDrawer
from services.twin.tasks.place_phone import PlacePhone
from services.twin.tasks.place_shoes import PlaceShoes
from services.twin.tasks.squeeze_ball import SqueezeBall
from services.twin.tasks.stack_bowls import StackBowls
from services.twin.tasks.stand_bottle import StandBottle
from services.twin.tasks.strike_bell import StrikeBell
from services.twin.tasks.task import Task
from services.twin.tasks.turn_lever import TurnLever

__all__ = ["EVALUATED", "TASK_NAMES", "TASK_SETS", "Task", "get_task", "named_tasks"]

_TASKS: Final[dict[str, Task]] = {
    task.name: task
    for task in (
        StandBottle(),
        StackBowls(),
        InsertPeg(),
        PlaceShoes(),
        PlacePhone(),
        OpenDrawer(),
        *CAN_TASKS,
        RegraspCan(),
        LiftBox(),
        TurnLever(),
        StrikeBell(),
        SqueezeBall(),
    )
}


def get_task(name: str) -> Task:
    """Get a task by name; raises UnknownNameError if there is none."""
    if name not in _TASKS:
        raise UnknownNameError("task", name, list(_TASKS))
    return _TASKS[name]


def named_tasks(names: Iterable[str]) -> tuple[str, ...]:
    """Names of tasks, each once, by task or `TASK_SETS`; raises UnknownNameError for others."""
    found: dict[str, None] = {}
    for name in names:
        if name not in TASK_SETS and name not in _TASKS:
            raise UnknownNameError("task or set of tasks", name, [*TASK_SETS, *_TASKS])
        found |= dict.fromkeys(TASK_SETS.get(name, (name,)))
    return tuple(found)
