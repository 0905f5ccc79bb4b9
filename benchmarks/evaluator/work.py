"""Rows of one policy from one start, and the missing rows of a start as a unit of work.

Networks are opened once in a process; rows are computed from kept arrays where these exist.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from benchmarks.direct_judge import DirectJudge
from benchmarks.evaluator.keeping import (
    KeptRows,
    Row,
    array_path,
    read_arrays,
    row_key,
    write_arrays,
)
from benchmarks.evaluator.lines import VERDICTS
from benchmarks.evaluator.plan import StudyPlan, Trained, mistakes_digest
from benchmarks.evaluator.playing import (
    ImaginedRollout,
    StillRollout,
    TrueRollout,
    chunk_figures,
    chunks_that_move,
    contact_with_true_context,
    hold_still,
    play_in_imagination,
    play_in_twin,
    sharpness_of_chunks,
    start_in_twin,
    still_figures,
    wrong_action_figures,
)
from dextouch.clients import Policy
from dextouch.errors import DexTouchError, InvalidInputError
from dextouch.hands.actions import poses_from_actions
from dextouch.schemas import RolloutStart, RolloutUncertainty
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import BatchWorld
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.matched_starts import first_digest, refuse_training_starts
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.success_classifier import DECISION_THRESHOLD, SuccessClassifier
from services.networks.weight_files import digest_of
from services.twin.scene import object_boxes_m
from services.twin.settings import TwinSettings
from services.twin.stage import (
    ELSEWHERE,
    HOLD,
    Actions,
    mistake_of,
    script_name,
    scripted_actions,
)
from services.twin.world import TwinWorld
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

    Raises InvalidInputError for direct judges, or worlds without touch, of different tasks.
    """
    refuse_unequal_tasks("--direct", [m.direct.metadata.tasks for m in members if m.direct])
    worlds = [m.untouched.description.tasks for m in members if m.untouched]
    refuse_unequal_tasks("--without-touch", worlds)


def refuse_unequal_tasks(flag: str, known: Sequence[Collection[str]]) -> None:
    """Refuse networks of several training seeds that were trained on different tasks.

    Raises InvalidInputError for different tasks.
    """
    if any(set(tasks) != set(known[0]) for tasks in known):
        raise InvalidInputError(
            f"evaluator: {flag}: got networks of {[sorted(tasks) for tasks in known]}, "
            "expected the same tasks for all; train them on the same tasks"
        )


def write_single_members(world: Path | None, folder: Path) -> list[Path]:
    """Write a checkpoint of every member of a state model's ensemble (None: the package's own).

    Raises CorruptDataError if it is none.
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


# Digests that each kind of row depends on, in addition to task, seed and policy.
DEPENDS_ON: Final[dict[str, tuple[str, ...]]] = {
    "real": ("twin",),
    "imagined": ("twin", "world"),
    "true verdict": ("twin", "judge"),
    "imagined verdict": ("twin", "world", "judge"),
    "verdict without touch": ("twin", "world", "judge"),
    "verdict of the last image": ("twin", "world", "judge"),
    "sharpness": ("twin", "world"),
    "true context": ("twin", "world"),
    "wrong actions": ("twin", "world"),
    "held still": ("twin", "world"),
    "direct verdict": ("twin", "direct judge"),
    "verdict of a world without touch": ("twin", "world without touch", "judge"),
}


class PolicyRollout:
    """One policy from one start, in the twin and in the world of every training seed.

    Arrays that exist in the folder `keep` are not computed again. `about` are the task, the seed
    and the name of the policy; of a policy with a mistake also the digest of the mistakes, since
    only the ending of its rollouts is kept. `actor` is the policy, or its actions.
    """

    def __init__(
        self, twin: TwinWorld, keep: Path, about: dict[str, Any], actor: Policy | Actions
    ) -> None:
        self._twin, self._keep, self._actor = twin, keep, actor
        self._shows_chunks = "mistakes" not in about
        self._about = about
        self._task, self._seed = str(about["task"]), int(about["seed"])
        self._stage = twin.stage(self._task)
        self._boxes_m = object_boxes_m(self._stage.simulation.scene)
        self._started, self._first, self._for_policy = start_in_twin(
            twin, self._task, self._seed, self._stage.task.instruction
        )
        self.imagined = cache(self._imagined)
        self._rows: dict[str, Callable[[Member], dict[str, Any]]] = {
            "real": lambda _: {"success": self.real.success},
            "imagined": self._imagined_row,
            "true verdict": lambda member: asdict(member.probe.verdict(self._true_ending)),
            "imagined verdict": lambda m: asdict(m.probe.verdict(self._imagined_ending(m))),
            "verdict without touch": lambda m: asdict(
                m.probe.verdict(without_touch(self._imagined_ending(m)))
            ),
            "verdict of the last image": self._last_image_row,
            "sharpness": lambda m: {"sharpness": sharpness_of_chunks(self.real, self.imagined(m))},
            "true context": self._context_row,
            "held still": self._still_row,
            "direct verdict": self._direct_row,
            "verdict of a world without touch": self._untouched_row,
        }  # fmt: skip

    def row(self, kind: str, member: Member) -> Row:
        """Content of one kind of row, without its identity."""
        return self._rows[kind](member)

    def wrong_actions(self, member: Member, own: "PolicyRollout") -> Row:
        """Errors where this policy's actions are imagined in place of those of `own`."""
        return wrong_action_figures(own.real, own.imagined(member), self.imagined(member))

    @cached_property
    def real(self) -> TrueRollout:
        """The rollout in the twin."""
        path = self._path("real", self._twin.description.digest)
        if path.is_file():
            kept = read_arrays(path)
            return TrueRollout(success=bool(kept.pop("success")), **kept)
        real = play_in_twin(
            self._twin, self._started, self._actor, self._for_policy,
            shows_chunks=self._shows_chunks,
        )  # fmt: skip
        write_arrays(path, vars(real) | {"success": np.array(real.success)})
        return real

    def _imagined(self, member: Member) -> ImaginedRollout:
        return self._imagined_by(member.world)

    def _imagined_by(self, world: BatchWorld[Any]) -> ImaginedRollout:
        path = self._path("imagined", self._twin.description.digest, world.description.digest)
        if path.is_file():
            kept = read_arrays(path)
            poses = kept.pop("object_poses", None)
            uncertainty = RolloutUncertainty.model_validate_json(str(kept.pop("uncertainty")))
            return ImaginedRollout(**kept, object_poses=poses, uncertainty=uncertainty)
        imagined = play_in_imagination(
            world, self._first, self._actor, self._for_policy, shows_chunks=self._shows_chunks
        )
        arrays = {n: a for n, a in vars(imagined).items() if isinstance(a, np.ndarray)}
        write_arrays(
            path, arrays | {"uncertainty": np.array(imagined.uncertainty.model_dump_json())}
        )
        return imagined

    def _path(self, kind: str, *digests: str) -> Path:
        return array_path(self._keep, kind=kind, digests=digests, **self._about)

    @property
    def _first_image(self) -> np.ndarray:
        return self._started.observation.images[HEAD_CAMERA][0]

    def _imagined_row(self, member: Member) -> Row:
        imagined = self.imagined(member)
        figures = chunk_figures(
            self.real,
            imagined,
            self._started.anchor,
            self._started.K_head,
            self._first_image,
            self._boxes_m,
        )
        return {"unreliable": imagined.uncertainty.reason, **figures}

    @property
    def _true_ending(self) -> Ending:
        touch = self.real.tactile_kpa[-NUM_SEEN_STEPS:]
        return Ending(self.real.last_images, touch, self._task)

    def _imagined_ending(self, member: Member) -> Ending:
        return self.imagined(member).ending(self._task)

    def _context_row(self, member: Member) -> Row:
        contact = contact_with_true_context(
            self._twin, member.world, self._started, self._first, self.real
        )
        commands = poses_from_actions(self.real.actions, self._started.anchor)
        moves = chunks_that_move(commands, self.real.object_poses)
        return {"contact": contact, "moves": moves.tolist()}

    def _still_row(self, member: Member) -> Row:
        """Hands commanded to stay at their observed poses, whatever was last commanded."""
        row = self._started.observation.action_reached[-1]
        path = self._path("held_still", self._twin.description.digest)
        if not path.is_file():
            request = RolloutStart(self._task, self._seed, self._first.instruction)
            true = hold_still(self._twin, request, row)
            write_arrays(path, {"images": true.images})
        imagined: StillRollout = hold_still(member.world, self._first, row)
        return still_figures(imagined, read_arrays(path)["images"], self._first_image)

    def _last_image_row(self, member: Member) -> Row:
        """Verdict on an ending without touch and without object poses."""
        ending = replace(without_touch(self._imagined_ending(member)), object_poses=None)
        return asdict(member.probe.verdict(ending))

    def _untouched_row(self, member: Member) -> Row:
        """Verdict on the ending of a world model trained without touch, with touch at zero."""
        if member.untouched is None:
            raise InvalidInputError("evaluator: no world was given by --without-touch")
        ending = self._imagined_by(member.untouched).ending(self._task)
        return asdict(member.probe.verdict(without_touch(ending)))

    def _direct_row(self, member: Member) -> Row:
        """Verdict of the direct judge, given the first observation and the twin's commands."""
        if member.direct is None:
            raise InvalidInputError("evaluator: no direct judge was given; name one by --direct")
        probability = member.direct.probability(self._first, self.real.actions)
        return {"probability": probability, "likely_success": probability >= DECISION_THRESHOLD}


def without_touch(ending: Ending) -> Ending:
    """The ending with all taxels at zero."""
    return replace(ending, tactile_kpa=np.zeros_like(ending.tactile_kpa))


# Name of a row: its kind, and the index of the training seed.
RowName = tuple[str, int]
Missing = Mapping[str, Sequence[RowName]]
EXACT = script_name(0.0)
# Rows that every rollout needs, unless its policy has a mistake, and those of scripts only.
NEEDED = ("real", "imagined", "true verdict", "imagined verdict")
_OF_SCRIPTS = ("verdict of the last image", "sharpness", "true context")


class Study:
    """The twin, the networks of every training seed and the policies, opened once in a process."""

    def __init__(self, plan: StudyPlan) -> None:
        torch.set_num_threads(1)
        self.plan = plan
        self.twin = TwinWorld(TwinSettings(cameras=(HEAD_CAMERA,)))
        self.members = open_members(plan.trained)
        refuse_unequal_rivals(self.members)
        self.cloned = {one.key: BehaviourCloningPolicy.load(one.path) for one in plan.cloned}
        outside = {one.key: one.source.load({}) for one in plan.outside}
        self.actors: dict[str, Policy] = {**self.cloned, **outside}

    @property
    def about(self) -> dict[str, str]:
        """Digests of all networks, numbered if there are several training seeds."""
        found = {"twin": self.twin.description.digest}
        for index, member in enumerate(self.members, 1):
            suffix = f" {index}" if len(self.members) > 1 else ""
            found |= {name + suffix: digest for name, digest in member.about.items()}
        return found

    @property
    def tasks(self) -> tuple[str, ...]:
        """Requested tasks that the twin and the networks of all training seeds support."""
        known = set(self.twin.description.tasks).intersection(*(m.tasks for m in self.members))
        return tuple(task for task in self.plan.tasks if task in known)

    def policies(self, task: str, seed: int) -> tuple[str, ...]:
        """The policies that can act in a task, and those with mistakes from this start."""
        usual = (
            name
            for name in self.plan.policies
            if task in getattr(self.actors.get(name), "tasks", (task,))
        )
        return (*usual, *(self.plan.kinds.policies(seed) if self.plan.kinds else ()))

    def keys(self, task: str, seed: int, policy: str) -> dict[RowName, dict[str, Any]]:
        """Identity of each row of a rollout."""
        rollout = self._about(task, seed, policy)
        found: dict[RowName, dict[str, Any]] = {}
        for number, member in enumerate(self.members):
            digests = {"twin": self.twin.description.digest, **member.about}
            for kind in self.kinds(task, seed, policy, member):
                needed = {name: digests[name] for name in DEPENDS_ON[kind]}
                found[kind, number] = {"kind": kind, **needed, **rollout}
        return found

    def kinds(self, task: str, seed: int, policy: str, member: Member) -> tuple[str, ...]:
        """The kinds of rows that a policy has from a start."""
        if mistake_of(policy) is not None:
            return VERDICTS
        kinds = [*NEEDED, "verdict without touch"]
        if member.direct is not None and task in member.direct.metadata.tasks:
            kinds.append("direct verdict")
        if policy in self.plan.scripts:
            kinds += _OF_SCRIPTS
            if member.untouched is not None and task in member.untouched.description.tasks:
                kinds.append("verdict of a world without touch")
        if policy == ELSEWHERE and EXACT in self.plan.scripts:
            kinds.append("wrong actions")
        if policy == HOLD and seed in self.plan.seeds[: self.plan.num_still_starts]:
            kinds.append("held still")
        return tuple(kinds)

    def missing(self, kept: KeptRows, task: str, seed: int) -> dict[str, tuple[RowName, ...]]:
        """Missing rows of a start, by policy."""
        found = {}
        for policy in self.policies(task, seed):
            # Training seeds may share rows: twin and judge are often the same.
            names = {
                row_key(key): name
                for name, key in self.keys(task, seed, policy).items()
                if kept.get(**key) is None
            }
            if names:
                found[policy] = tuple(names.values())
        return found

    def rows(self, task: str, seed: int, missing: Missing) -> Iterator[Row]:
        """Roll out and judge; rollouts with kept arrays are not repeated.

        Raises ConflictError if a judge or cloned policy was trained on this start.
        """
        self._refuse_training_start(task, seed)
        for policy, names in missing.items():
            keys, rollout = self.keys(task, seed, policy), None
            for name in names:
                try:
                    rollout = rollout or self._rollout(task, seed, policy)
                    kind, member = name[0], self.members[name[1]]
                    if kind == "wrong actions":
                        row = rollout.wrong_actions(member, self._rollout(task, seed, EXACT))
                    else:
                        row = rollout.row(kind, member)
                    yield {**keys[name], **row}
                except DexTouchError as error:
                    yield {**keys[name], "error": type(error).__name__, "message": error.message}

    def _rollout(self, task: str, seed: int, policy: str) -> PolicyRollout:
        about = self._about(task, seed, policy)
        return PolicyRollout(self.twin, self.plan.keep, about, self.actor(task, seed, policy))

    @staticmethod
    def _about(task: str, seed: int, policy: str) -> dict[str, Any]:
        about: dict[str, Any] = {"task": task, "seed": seed, "policy": policy}
        return about if mistake_of(policy) is None else about | {"mistakes": mistakes_digest()}

    def _refuse_training_start(self, task: str, seed: int) -> None:
        instruction = self.twin.stage(task).task.instruction
        first = start_in_twin(self.twin, task, seed, instruction)[0].observation
        digest = first_digest(first)
        trained = [("a judge", one.metadata) for m in self.members for one in m.judges]
        trained += [(name, one.metadata) for name, one in self.cloned.items()]
        for what, metadata in trained:
            refuse_training_starts([digest], trained_on=metadata.training_starts, what=what)

    def actor(self, task: str, seed: int, policy: str) -> Policy | Actions:
        """A closed-loop policy, or the actions of an open-loop one."""
        if policy in self.actors:
            return self.actors[policy]
        return scripted_actions(self.twin.stage(task), seed, policy)


@lru_cache(maxsize=1)
def open_study(plan: StudyPlan) -> Study:
    """The study of this process."""
    return Study(plan)


def unit_rows(plan: StudyPlan, task: str, seed: int, missing: Missing) -> list[Row]:
    """Compute the missing rows of one start, in a worker process."""
    return list(open_study(plan).rows(task, seed, missing))
