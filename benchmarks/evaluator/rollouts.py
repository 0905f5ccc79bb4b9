"""Rows of one policy from one start, computed from kept arrays where these exist."""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.evaluator.keeping import Row, array_path, read_arrays, write_arrays
from benchmarks.evaluator.measuring import chunk_figures, sharpness_of_chunks, wrong_action_figures
from benchmarks.evaluator.members import Member
from benchmarks.evaluator.playing import (
    ImaginedRollout,
    TrueRollout,
    play_in_imagination,
    play_in_twin,
    start_in_twin,
)
from benchmarks.evaluator.restarts import chunks_that_move, contact_with_true_context
from benchmarks.evaluator.still_hand import StillRollout, hold_still, still_figures
from dextouch.clients import Policy
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import poses_from_actions
from dextouch.schemas import RolloutStart, RolloutUncertainty
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import BatchWorld
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.success_classifier import DECISION_THRESHOLD
from services.twin.scene import object_boxes_m
from services.twin.scripted_actions import Actions
from services.twin.world import TwinWorld

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
            asked = RolloutStart(self._task, self._seed, self._first.instruction)
            true = hold_still(self._twin, asked, row)
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
