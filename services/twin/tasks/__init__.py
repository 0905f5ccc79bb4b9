"""The twin's tasks: each brings its objects, where they start, a demonstrator and a judge."""

from services.twin.tasks.registry import TASK_NAMES, get_task
from services.twin.tasks.task import Task

__all__ = ["TASK_NAMES", "Task", "get_task"]
