"""Tasks of the twin, each with objects, placement, demonstrator and success check."""

from services.twin.tasks.registry import EVALUATED, TASK_NAMES, TASK_SETS, get_task, named_tasks
from services.twin.tasks.task import Task

__all__ = ["EVALUATED", "TASK_NAMES", "TASK_SETS", "Task", "get_task", "named_tasks"]
