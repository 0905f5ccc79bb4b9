"""The networks of each training seed, opened once in a process."""

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from dextouch.worlds.world import BatchWorld
from services.cli.bench.evaluator.plan import Trained
from services.evaluation.success_probe import SuccessProbe
from services.world_model.world import open_world


@dataclass(frozen=True, eq=False)
class Member:
    """A world model and its judge; `about` are the digests that results are known by."""

    about: dict[str, str]
    world: BatchWorld[Any]
    probe: SuccessProbe

    @property
    def tasks(self) -> set[str]:
        """The tasks that all its networks know."""
        return set(self.world.description.tasks) & set(self.probe.metadata.tasks)


def open_members(trained: tuple[Trained, ...]) -> tuple[Member, ...]:
    """The networks of every training seed; a file that several share is opened once."""
    worlds, probes = cache(open_world), cache(SuccessProbe.load)
    found = []
    for one in trained:
        world: BatchWorld[Any] = worlds(one.world)
        about = {"world": world.description.digest, "judge": file_digest(one.probe)}
        found.append(Member(about, world, probes(one.probe)))
    return tuple(found)


def file_digest(path: Path) -> str:
    """sha256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
