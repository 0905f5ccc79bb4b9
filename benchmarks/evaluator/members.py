"""The networks of each training seed, opened once in a process."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.direct_judge import DirectJudge
from benchmarks.evaluator.plan import Trained
from dextouch.errors import InvalidInputError
from dextouch.worlds import BatchWorld
from services.evaluation.success_classifier import SuccessClassifier
from services.networks.weight_files import digest_of
from services.world_model.checkpoints import read_state_checkpoint, write_state_checkpoint
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.shipped_checkpoints import default_checkpoint
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


def write_single_members(world: Path | None, folder: Path) -> list[Path]:
    """Write a checkpoint of every member of a state model's ensemble (None: the package's own).

    Raises:
        CorruptDataError: not a state model.
    """
    whole = read_state_checkpoint(world or default_checkpoint())
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for member in range(whole.metadata.num_members):
        name = f"{whole.metadata.name}, member {member} alone"
        metadata = whole.metadata.model_copy(update={"num_members": 1, "name": name})
        paths.append(folder / f"{whole.digest[:12]}_member_{member}.safetensors")
        alone = single_member(whole.dynamics, member)
        write_state_checkpoint(paths[-1], alone, whole.renderer, metadata)
    return paths


def single_member(ensemble: DynamicsModel, member: int) -> DynamicsModel:
    """A dynamics model of one member's start reader and core, and the shared touch codec."""
    alone = DynamicsModel(ensemble.config).eval()
    alone.codec.load_state_dict(ensemble.codec.state_dict())
    alone.readers()[0].load_state_dict(ensemble.readers()[member].state_dict())
    weights = {
        name: tensor[member : member + 1].clone()
        for name, tensor in ensemble.core.named_parameters()
    }
    alone.core.load_state_dict(weights | dict(ensemble.core.named_buffers()))
    return alone
