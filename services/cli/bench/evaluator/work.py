"""All rollouts of one start that are not kept yet: one unit of work of the stage `evaluator`."""

import hashlib
from collections.abc import Iterator
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dextouch.clients.policy import Policy
from dextouch.errors import DexTouchError
from dextouch.worlds.world import BatchWorld
from services.cli.bench.evaluator.keeping import (
    KeptRows,
    Row,
    array_path,
    read_arrays,
    write_arrays,
)
from services.cli.bench.evaluator.measuring import chunk_figures
from services.cli.bench.evaluator.plan import CAMERA, StudyPlan
from services.cli.bench.evaluator.playing import (
    Actions,
    ImaginedRollout,
    TrueRollout,
    play_in_imagination,
    play_in_twin,
    scripted_actions,
    start_in_twin,
)
from services.evaluation.closed_loop import first_digest
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.starts import refuse_training_starts
from services.evaluation.success_probe import SuccessProbe
from services.twin.bounding_boxes import object_boxes_m
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld
from services.world_model.world import open_world


class Study:
    """The worlds, the judge and the policies of a plan, opened once in a process."""

    def __init__(self, plan: StudyPlan) -> None:
        torch.set_num_threads(1)
        self.plan = plan
        self.twin = TwinWorld(TwinSettings(cameras=(CAMERA,)))
        self.world: BatchWorld[Any] = open_world(plan.world)
        self.probe = SuccessProbe.load(plan.probe)
        self.cloned = {one.key: BehaviourCloningPolicy.load(one.path) for one in plan.cloned}
        self.about = {
            "twin": self.twin.description.digest,
            "world": self.world.description.digest,
            "judge": hashlib.sha256(plan.probe.read_bytes()).hexdigest(),
        }

    @property
    def tasks(self) -> tuple[str, ...]:
        """The asked tasks that twin, world and judge all know."""
        known = set(self.world.description.tasks) & set(self.probe.shape.tasks)
        return tuple(t for t in self.plan.tasks if t in known & set(self.twin.description.tasks))

    def policies(self, task: str) -> tuple[str, ...]:
        """The policies that can act in a task."""
        return tuple(
            name
            for name in self.plan.policies
            if name not in self.cloned or task in self.cloned[name].shape.tasks
        )

    def keys(self, task: str, seed: int, policy: str) -> dict[str, dict[str, Any]]:
        """What each row of a rollout is about: the real one, the imagined one, and two verdicts."""
        rollout = {"task": task, "seed": seed, "policy": policy}
        twin, world, judge = (self.about[name] for name in ("twin", "world", "judge"))
        return {
            "real": {"kind": "real", "twin": twin, **rollout},
            "imagined": {"kind": "imagined", "twin": twin, "world": world, **rollout},
            "true verdict": {"kind": "true verdict", "twin": twin, "judge": judge, **rollout},
            "imagined verdict": {
                "kind": "imagined verdict", "twin": twin, "world": world, "judge": judge, **rollout,
            },
        }  # fmt: skip

    def missing(self, kept: KeptRows, task: str, seed: int) -> list[str]:
        """The policies of a start of which a row is not kept yet."""
        return [
            policy
            for policy in self.policies(task)
            if any(kept.get(**key) is None for key in self.keys(task, seed, policy).values())
        ]

    def rows(self, task: str, seed: int, policies: list[str]) -> Iterator[Row]:
        """Roll out and judge; rollouts whose arrays are kept are not made again.

        Raises:
            ConflictError: judge or cloned policy were trained on this start.
        """
        self._refuse_training_start(task, seed)
        for policy in policies:
            keys = self.keys(task, seed, policy)
            try:
                yield from _Rollout(self, task, seed, policy).rows(keys)
            except DexTouchError as error:
                yield from (
                    {**key, "error": type(error).__name__, "message": error.message}
                    for key in keys.values()
                )

    def _refuse_training_start(self, task: str, seed: int) -> None:
        instruction = self.twin.stage(task).task.instruction
        first = start_in_twin(self.twin, task, seed, instruction)[0].observation
        digest = first_digest(first)
        trained = {"the success probe": self.probe.metadata.training_starts}
        trained |= {name: one.metadata.training_starts for name, one in self.cloned.items()}
        for what, starts in trained.items():
            refuse_training_starts([digest], trained_on=starts, what=what)

    def actor(self, task: str, seed: int, policy: str) -> Policy | Actions:
        """A policy that looks, or the actions of one that does not."""
        if policy in self.cloned:
            return self.cloned[policy]
        return scripted_actions(self.twin.stage(task), seed, policy, self.plan.levels_mm)


class _Rollout:
    """One policy from one start."""

    def __init__(self, study: Study, task: str, seed: int, policy: str) -> None:
        self._study, self._task, self._seed, self._policy = study, task, seed, policy
        self._actor = study.actor(task, seed, policy)
        stage = study.twin.stage(task)
        self._boxes_m = object_boxes_m(stage.simulation.scene)
        self._started, self._first, self._for_policy = start_in_twin(
            study.twin, task, seed, stage.task.instruction
        )

    def rows(self, keys: dict[str, dict[str, Any]]) -> Iterator[Row]:
        """Rows of both rollouts and both verdicts."""
        keep, probe = self._study.plan.keep, self._study.probe
        real = self._real(array_path(keep, **keys["real"]))
        yield {**keys["real"], "success": real.success}
        imagined, figures = self._imagined(array_path(keep, **keys["imagined"]), real)
        yield {**keys["imagined"], "doubted": imagined.doubted, **figures}
        endings = {
            "true verdict": Ending(
                real.last_images, real.tactile_kpa[-NUM_SEEN_STEPS:], self._task
            ),
            "imagined verdict": Ending(
                imagined.last_images,
                imagined.tactile_kpa[-NUM_SEEN_STEPS:],
                self._task,
                imagined.object_poses,
                imagined=True,
                doubted=imagined.doubted,
            ),
        }
        for name, ending in endings.items():
            verdict = asdict(probe.verdict(ending))
            yield {**keys[name], **verdict}

    def _real(self, path: Path) -> TrueRollout:
        if path.is_file():
            kept = read_arrays(path)
            return TrueRollout(success=bool(kept.pop("success")), **kept)
        real = play_in_twin(self._study.twin, self._started, self._actor, self._for_policy)
        write_arrays(path, vars(real) | {"success": np.array(real.success)})
        return real

    def _imagined(self, path: Path, real: TrueRollout) -> tuple[ImaginedRollout, dict[str, Any]]:
        if path.is_file():
            kept = read_arrays(path)
            poses, doubted = kept.pop("object_poses", None), str(kept.pop("doubted"))
            imagined = ImaginedRollout(**kept, object_poses=poses, doubted=doubted or None)
        else:
            world = self._study.world
            imagined = play_in_imagination(world, self._first, self._actor, self._for_policy)
            arrays = {n: a for n, a in vars(imagined).items() if isinstance(a, np.ndarray)}
            write_arrays(path, arrays | {"doubted": np.array(imagined.doubted or "")})
        figures = chunk_figures(
            real,
            imagined,
            self._started.anchor,
            self._started.K_head,
            self._started.observation.images[CAMERA][0],
            self._boxes_m,
        )
        return imagined, dict(figures)


@lru_cache(maxsize=1)
def open_study(plan: StudyPlan) -> Study:
    """The study of this process."""
    return Study(plan)


def unit_rows(plan: StudyPlan, task: str, seed: int, policies: tuple[str, ...]) -> list[Row]:
    """What a worker process does."""
    return list(open_study(plan).rows(task, seed, list(policies)))
