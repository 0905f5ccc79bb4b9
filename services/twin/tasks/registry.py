"""Registry of the twin's tasks by name."""

from typing import Final

from dextouch.errors import UnknownNameError
from services.twin.tasks.cans import CAN_TASKS
from services.twin.tasks.insert_peg import InsertPeg
from services.twin.tasks.open_drawer import OpenDrawer
from services.twin.tasks.place_phone import PlacePhone
from services.twin.tasks.place_shoes import PlaceShoes
from services.twin.tasks.regrasp_can import RegraspCan
from services.twin.tasks.stack_bowls import StackBowls
from services.twin.tasks.stand_bottle import StandBottle
from services.twin.tasks.task import Task

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
    )
}
TASK_NAMES: Final = tuple(_TASKS)
# Tasks of the package's checkpoints; commands record and evaluate these by default.
EVALUATED: Final = (
    "stand_bottle",
    "stack_bowls",
    "insert_peg",
    "place_shoes",
    "place_phone",
    "open_drawer",
)


def get_task(name: str) -> Task:
    """Get a task by name.

    Raises:
        UnknownNameError: no such task.
    """
    if name not in _TASKS:
        raise UnknownNameError("task", name, list(_TASKS))
    return _TASKS[name]
