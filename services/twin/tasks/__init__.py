"""Tasks of the twin, each with objects, placement, demonstrator and success check."""

from services.twin.names import EVALUATED, TASK_NAMES, TASK_SETS
from services.twin.tasks.registry import get_task, named_tasks
from services.twin.tasks.task import Task

__all__ = ["EVALUATED", "TASK_NAMES", "TASK_SETS", "Task", "get_task", "named_tasks"]
