"""Robot episodes with instructions, as every training of this service has them."""

from collections.abc import Iterable
from typing import Protocol, runtime_checkable


@runtime_checkable
class Instructed(Protocol):
    """Anything with a task and its instruction."""

    @property
    def task(self) -> str:
        """Name of the task."""

    @property
    def instruction(self) -> str:
        """Instruction of the task."""


def instructions_of(demonstrations: Iterable[Instructed]) -> dict[str, str]:
    """Instruction of every task, from its first episode."""
    found: dict[str, str] = {}
    for item in demonstrations:
        found.setdefault(item.task, item.instruction)
    return found
