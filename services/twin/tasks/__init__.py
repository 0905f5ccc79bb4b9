"""Tasks of the twin, each with objects, placement, demonstrator and success check."""

from services.twin.tasks.registry import EVALUATED, TASK_NAMES, get_task
from services.twin.tasks.task import Task

__all__ = ["EVALUATED", "TASK_NAMES", "Task", "get_task"]
