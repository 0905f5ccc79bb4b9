"""Missing rows of one start, the unit of work of the stage `evaluator`."""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch

from benchmarks.evaluator.keeping import KeptRows, Row, row_key
from benchmarks.evaluator.kind_lines import VERDICTS
from benchmarks.evaluator.kinds import mistakes_digest
from benchmarks.evaluator.members import Member, open_members, refuse_unequal_rivals
from benchmarks.evaluator.plan import StudyPlan
from benchmarks.evaluator.playing import start_in_twin
from benchmarks.evaluator.rollouts import DEPENDS_ON, PolicyRollout
from dextouch.clients import Policy
from dextouch.errors import DexTouchError
from dextouch.streams import HEAD_CAMERA
from services.evaluation.matched_starts import first_digest, refuse_training_starts
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.twin.scripted_actions import (
    ELSEWHERE,
    HOLD,
    Actions,
    mistake_of,
    script_name,
    scripted_actions,
)
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld

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

        Raises:
            ConflictError: a judge or cloned policy was trained on this start.
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
