"""The networks of each training seed, opened once in a process."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from benchmarks.direct_judge import DirectJudge
from benchmarks.evaluator.plan import Trained
from dextouch.errors import InvalidInputError
from dextouch.worlds import BatchWorld
from services.evaluation.success_classifier import SuccessClassifier
from services.networks.weight_files import digest_of
from services.world_model.world import open_world


@dataclass(frozen=True, eq=False)
class Member:
    """A world model, its judge, and its baselines if there are any.

    `direct` judges without imagining; `untouched` is a world model trained without touch.
    `about` holds the digests that identify results.
    """

    about: dict[str, str]
    world: BatchWorld[Any]
    probe: SuccessClassifier
    direct: DirectJudge | None = None
    untouched: BatchWorld[Any] | None = None

    @property
    def tasks(self) -> set[str]:
        """Tasks that all its networks were trained on."""
        return set(self.world.description.tasks) & set(self.probe.metadata.tasks)

    @property
    def judges(self) -> list[SuccessClassifier | DirectJudge]:
        """All judges, each of which has training starts."""
        return [self.probe, *([] if self.direct is None else [self.direct])]


def open_members(trained: tuple[Trained, ...]) -> tuple[Member, ...]:
    """The networks of every training seed; a file that several share is opened once."""
    worlds, probes, directs = (
        cache(open_world),
        cache(SuccessClassifier.load),
        cache(DirectJudge.load),
    )
    found = []
    for one in trained:
        world: BatchWorld[Any] = worlds(one.world)
        about = {"world": world.description.digest, "judge": digest_of(one.probe)}
        if one.direct is not None:
            about["direct judge"] = digest_of(one.direct)
        direct = None if one.direct is None else directs(one.direct)
        untouched: BatchWorld[Any] | None = None if one.untouched is None else worlds(one.untouched)
        if untouched is not None:
            about["world without touch"] = untouched.description.digest
        found.append(Member(about, world, probes(one.probe), direct, untouched))
    return tuple(found)


def refuse_unequal_rivals(members: Sequence[Member]) -> None:
    """Refuse baselines of the training seeds that were not trained on the same tasks.

    Raises:
        InvalidInputError: direct judges, or worlds without touch, of different tasks.
    """
    refuse_unequal_tasks("--direct", [m.direct.metadata.tasks for m in members if m.direct])
    worlds = [m.untouched.description.tasks for m in members if m.untouched]
    refuse_unequal_tasks("--without-touch", worlds)


def refuse_unequal_tasks(flag: str, known: Sequence[Collection[str]]) -> None:
    """Refuse networks of several training seeds that were trained on different tasks.

    Raises:
        InvalidInputError: different tasks.
    """
    if any(set(tasks) != set(known[0]) for tasks in known):
        raise InvalidInputError(
            f"evaluator: {flag}: got networks of {[sorted(tasks) for tasks in known]}, "
            "expected the same tasks for all; train them on the same tasks"
        )
