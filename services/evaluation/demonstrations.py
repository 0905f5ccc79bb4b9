"""Split of robot episodes by task and seed, and their instructions."""

import hashlib
from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar, runtime_checkable

from dextouch.errors import InvalidInputError

CAMERA = "camera_head"


@runtime_checkable
class Seeded(Protocol):
    """Anything with a task and a seed of the twin."""

    @property
    def task(self) -> str:
        """Name of the task."""

    @property
    def instruction(self) -> str:
        """Instruction of the task."""

    @property
    def seed(self) -> int:
        """Seed of the scene."""


SeededT = TypeVar("SeededT", bound=Seeded)


def split_by_seed(
    demonstrations: Sequence[SeededT], *, held_out_share: float, salt: str = ""
) -> tuple[list[SeededT], list[SeededT]]:
    """Training and held-out episodes; all episodes of a task and seed are on the same side.

    The side depends on a hash of task, seed and `salt` alone, so that adding episodes does not
    change it.
    """
    training: list[SeededT] = []
    held_out: list[SeededT] = []
    for item in demonstrations:
        digest = hashlib.sha256(f"{salt}{item.task}/{item.seed}".encode()).digest()
        share = int.from_bytes(digest[:4], "big") / 2**32
        (held_out if share < held_out_share else training).append(item)
    if not training or not held_out:
        raise InvalidInputError(
            f"split: {len(training)} training and {len(held_out)} held-out episodes of "
            f"{len(demonstrations)}; expected both sides, record more seeds"
        )
    return training, held_out


def instructions_of(demonstrations: Iterable[Seeded]) -> dict[str, str]:
    """Instruction of every task, from its first episode."""
    found: dict[str, str] = {}
    for item in demonstrations:
        found.setdefault(item.task, item.instruction)
    return found
