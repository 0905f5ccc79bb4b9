"""Dynamics model: an ensemble of start readers and recurrent cores that share a touch codec.

`begin` estimates object poses from one observed step; `advance` predicts object motion and touch
for the next commands. The only state kept between chunks is a `SceneMemory`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from torch import Tensor, nn

from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import split_pads
from services.world_model.dynamics.core import (
    NUM_PADS,
    CoreState,
    RecurrentCore,
    SceneFuture,
    SceneStart,
)
from services.world_model.dynamics.features import (
    FREE_KPA,
    STEPS_PER_LATENT,
    Commands,
    DynamicsConfig,
    HandMotion,
    ObjectPoses,
    TouchCodec,
)
from services.world_model.dynamics.members import folded, stacked, unfolded
from services.world_model.dynamics.start_reader import FirstStep, Reading, StartReader
from services.world_model.dynamics.traces import Traced

# Detection of resting hands and resting scenes, per latent step.
#
# Counting latent steps instead of chunks makes the result independent of how a client splits its
# commands into chunks.

# Hands that move less than this between latent steps count as still.
STILL_M = 1e-4
# After this many still latent steps (2 s) the scene counts as settled.
REST_LATENTS = 8


@dataclass(frozen=True)
class Stillness:
    """Latent steps in which the hands move, and in which the scene is at rest.

    `points_m` are the hand points when they last moved, `num_still` the number of latent steps
    since then, both after the last latent step.
    """

    points_m: Float32[Tensor, "batch 2 points 3"]
    num_still: Int64[Tensor, " batch"]
    moves: Bool[Tensor, "batch latents"]
    at_rest: Bool[Tensor, "batch latents"]

    def runs(self) -> Iterator[tuple[slice, Bool[Tensor, " batch"]]]:
        """Runs of latent steps in which the same entries are at rest, each with these entries."""
        first, num_latents = 0, self.at_rest.shape[1]
        for last in range(1, num_latents + 1):
            if last == num_latents or bool((self.at_rest[:, last] != self.at_rest[:, first]).any()):
                yield slice(first, last), self.at_rest[:, first]
                first = last


def stillness(
    points_m: Float32[Tensor, "batch 2 points 3"],
    num_still: Int64[Tensor, " batch"],
    commanded_m: Float32[Tensor, "batch latents looks 2 points 3"],
) -> Stillness:
    """Track hands that have stood at `points_m` for `num_still` latent steps.

    Hands move when they leave that position, however slowly. A scene is at rest in latent steps
    without hand motion that follow at least `REST_LATENTS` such steps.
    """
    moved, rested = [], []
    for looks_m in commanded_m.unbind(1):
        off_m = (looks_m - points_m[:, None]).norm(dim=-1).amax((-1, -2, -3))
        moves = off_m >= STILL_M
        rested.append(~moves & (num_still >= REST_LATENTS))
        moved.append(moves)
        points_m = torch.where(moves[:, None, None, None], looks_m[:, -1], points_m)
        num_still = torch.where(moves, 0, num_still + 1)
    return Stillness(points_m, num_still, torch.stack(moved, 1), torch.stack(rested, 1))


# Objects with a lower presence probability count as absent.
PRESENCE_THRESHOLD = 0.5
# Contact threshold of a taxel: probability 0.35. Where contact cannot be predicted with certainty,
# the threshold with the best F1 is half of that F1 (Lipton et al. 2014).
CONTACT_LOG_ODDS = -0.62


def pad_means_kpa(tactile_kpa: Float32[np.ndarray, "*batch 2 320"]) -> np.ndarray:
    """Mean pressure [..., 12] of thumb … little fingertip and palm, left hand, then right."""
    tips, palm = split_pads(tactile_kpa)
    pads = np.concatenate([tips.mean((-1, -2)), palm.mean((-1, -2))[..., None]], axis=-1)
    return pads.reshape(*pads.shape[:-2], NUM_PADS)


def first_steps(
    images: Sequence[UInt8[np.ndarray, "px px 3"]],
    Ks_head: Sequence[Float64[np.ndarray, "3 3"]],
    tactile_kpa: Sequence[Float32[np.ndarray, "2 320"]],
    hands: Sequence[HandMotion],
    tasks: Sequence[int],
) -> FirstStep:
    """A batch of observed steps as inputs of the readers; `hands` are of one step each."""
    return FirstStep(
        torch.from_numpy(np.stack(images)),
        torch.from_numpy(np.stack(Ks_head)).float(),
        torch.from_numpy(np.concatenate([one.Ts_world_camera for one in hands])).float(),
        torch.from_numpy(np.concatenate([one.points_m for one in hands])),
        torch.from_numpy(pad_means_kpa(np.stack(tactile_kpa))),
        torch.tensor(tasks),
    )


@dataclass(frozen=True)
class SceneMemory:
    """State of the dynamics that a rollout carries from one chunk to the next.

    `start` holds objects and touch at the first step as every member knows them, `state` the state
    of every member's core (both with axes members, batch, …), `poses` the current object poses
    (mean over members), `disagreement_m` the ensemble disagreement about them, `success` the
    members' probability that the task is done at the end, `points_m` the hand points when they last
    moved, and `num_still` the number of latent steps since then (at least `REST_LATENTS` from the
    start on for hands that touch nothing).
    """

    start: SceneStart
    state: CoreState
    poses: ObjectPoses
    disagreement_m: Float32[Tensor, " batch"]
    tactile_kpa: Float32[Tensor, "batch 2 320"]
    success: Float32[Tensor, "members batch"]
    points_m: Float32[Tensor, "batch 2 points 3"]
    num_still: Int64[Tensor, " batch"]


@dataclass(frozen=True)
class ImaginedSteps:
    """Predictions of the ensemble for the next 4k steps and the k latent steps they form.

    `disagreement_m` is the largest standard deviation over members of an object's position;
    `distance` is how far the hands' motion lies outside the range of training (0: inside);
    `success` is the probability of every member that the task is done at the end; `moves` marks
    latents in which hands move, `at_rest` those in which nothing moves any more.
    """

    poses: ObjectPoses
    tactile_kpa: Float32[Tensor, "batch steps 2 320"]
    disagreement_m: Float32[Tensor, "batch latents"]
    distance: Float32[Tensor, "batch latents"]
    success: Float32[Tensor, "members batch latents"]
    moves: Bool[Tensor, "batch latents"]
    at_rest: Bool[Tensor, "batch latents"]


class DynamicsModel(nn.Module):
    """Ensemble of start readers and cores trained from different seeds, with a shared touch codec.

    Args:
        config: configuration of every member.
        num_members: size of the ensemble, at least one.
    """

    def __init__(self, config: DynamicsConfig, num_members: int = 1) -> None:
        super().__init__()
        self.config = config
        self.codec = TouchCodec(config.touch_channels)
        self.eyes = nn.ModuleList(StartReader(config) for _ in range(num_members))
        self.core = RecurrentCore(config, num_members)
        self._predict: Callable[..., tuple[CoreState, _Run]] = self._predicted

    def trace(self) -> None:
        """Compute chunks by traces from now on; the weights must not change any more."""
        self._predict = Traced(self, self._predicted, self._kind_of)

    @torch.no_grad()
    def begin(
        self,
        first: FirstStep,
        tactile_kpa: Float32[Tensor, "batch 2 320"],
        standing: Commands,
        commanded: Float32[Tensor, " batch"],
    ) -> SceneMemory:
        """Estimate the scene at an observed step.

        If the hands touch nothing, the scene is at rest until they move.

        Args:
            first: the step as input of the readers.
            tactile_kpa: pressure at that step.
            standing: the measured hands, from `Commands.standing`.
            commanded: 1 if the rollout's actions are commanded, 0 if they are measured.
        """
        known = (self.codec.encode(tactile_kpa), first.pads_kpa, first.task, commanded)
        readings: list[Reading] = [reader(first) for reader in self.readers()]
        start = stacked([SceneStart(one.objects, one.sd_m, one.size, *known) for one in readings])
        each, still = folded(start), standing.repeated(self.core.members)
        future, state = self.core(still, each, self.core.first_state(each, still))
        return SceneMemory(
            start=start,
            state=unfolded(state, self.core.members),
            poses=mean_poses(start.objects),
            disagreement_m=_spread_m(start.objects),
            tactile_kpa=torch.minimum(tactile_kpa, self.codec.peak_kpa),
            success=unfolded(future, self.core.members).success[..., -1].sigmoid(),
            points_m=standing.points_m[:, -1, -1],
            num_still=REST_LATENTS * (tactile_kpa.amax((1, 2)) < FREE_KPA).long(),
        )

    @torch.no_grad()
    def advance(self, memory: SceneMemory, commands: Commands) -> tuple[SceneMemory, ImaginedSteps]:
        """Predict the steps that follow from commands.

        Entries whose hands have stood still for two seconds, and still do, are at rest: poses and
        touch stay constant. Splitting commands over several calls does not change the result.
        """
        still = stillness(memory.points_m, memory.num_still, commands.points_m)
        parts: list[_Run] = []
        for latents, at_rest in still.runs():
            memory, part = self._advance_run(memory, commands[latents], at_rest)
            parts.append(part)
        following = replace(memory, points_m=still.points_m, num_still=still.num_still)
        imagined = ImaginedSteps(
            ObjectPoses(
                torch.cat([part.poses.position_m for part in parts], dim=1),
                torch.cat([part.poses.axes for part in parts], dim=1),
                torch.cat([part.poses.present for part in parts], dim=1),
            ),
            torch.cat([part.tactile_kpa for part in parts], dim=1),
            torch.cat([part.disagreement_m for part in parts], dim=1),
            torch.cat([part.distance for part in parts], dim=1),
            torch.cat([part.success for part in parts], dim=2),
            still.moves,
            still.at_rest,
        )
        return following, imagined

    def _advance_run(
        self, memory: SceneMemory, commands: Commands, at_rest: Bool[Tensor, " batch"]
    ) -> tuple[SceneMemory, "_Run"]:
        """Advance by latent steps during which the same entries are at rest."""
        if bool(at_rest.all()):
            # The wrists are where they were commanded to be, for all members.
            return memory, _resting(memory, self.core.distance(commands, memory.state.wrist_m[0]))
        state, run = self._predict(commands, memory.start, memory.state, memory.poses)
        if bool(at_rest.any()):
            run = _chosen(at_rest, _resting(memory, run.distance), run)
            members, before = self.core.members, folded(memory.state)
            changed = folded(state).where(~at_rest.repeat(members), before)
            state = unfolded(changed, members)
        following = replace(
            memory,
            state=state,
            poses=run.poses[:, -1],
            disagreement_m=run.disagreement_m[:, -1],
            tactile_kpa=run.tactile_kpa[:, -1],
            success=run.success[..., -1],
        )
        return following, run

    def _predicted(
        self, commands: Commands, start: SceneStart, state: CoreState, poses: ObjectPoses
    ) -> tuple[CoreState, "_Run"]:
        """What all members predict: their states after the commands, and what they say together."""
        members = self.core.members
        future, after = self.core(commands.repeated(members), folded(start), folded(state))
        run = self._imagined(poses, future, self.core.distance(commands, state.wrist_m[0]))
        return unfolded(after, members), run

    def _kind_of(
        self, commands: Commands, start: SceneStart, state: CoreState, poses: ObjectPoses
    ) -> tuple[int, int, int]:
        """Latent steps, entries of the batch, and the slots that some entry uses."""
        del state, poses
        return len(commands), start.task.shape[1], self.core.used_slots(start.task[0])

    def readers(self) -> list[StartReader]:
        """The start reader of every member."""
        return [reader for reader in self.eyes if isinstance(reader, StartReader)]

    def _imagined(self, poses: ObjectPoses, future: SceneFuture, distance: Tensor) -> "_Run":
        members = self.core.members
        each = unfolded(future, members)
        taxels = self.core.taxels(future.pattern).view(*each.pattern.shape[:-1], -1)
        return _Run(
            poses=_between(poses, mean_poses(each.objects)),
            tactile_kpa=self.decode_touch(each.touch.mean(0), taxels.mean(0)).flatten(1, 2),
            disagreement_m=_spread_m(each.objects),
            distance=distance,
            success=each.success.sigmoid(),
        )

    def decode_touch(
        self,
        touch: Float32[Tensor, "*batch 2 channels"],
        taxels: Float32[Tensor, "*batch 2 320"],
    ) -> Float32[Tensor, "*batch 2 320"]:
        """Pressures in kPa from latents and from contact log odds of each taxel.

        Taxels in contact have at least the contact threshold pressure, all others have none.
        """
        touches = taxels > CONTACT_LOG_ODDS
        return self.codec.decode(touch).clamp_min(CONTACT_THRESHOLD_KPA) * touches


@dataclass(frozen=True)
class _Run:
    """Predictions for a run of latent steps."""

    poses: ObjectPoses
    tactile_kpa: Float32[Tensor, "batch steps 2 320"]
    disagreement_m: Float32[Tensor, "batch latents"]
    distance: Float32[Tensor, "batch latents"]
    success: Float32[Tensor, "members batch latents"]


def _spread_m(poses: ObjectPoses) -> Float32[Tensor, "*batch"]:
    """Largest standard deviation over members of the position of an object that is present."""
    used = poses.present.mean(0) > PRESENCE_THRESHOLD
    return (poses.position_m.std(0, correction=0).norm(dim=-1) * used).amax(-1)


def mean_poses(poses: ObjectPoses) -> ObjectPoses:
    """Mean over members, the first axis; those that see no object do not contribute to its pose."""
    share = poses.present / poses.present.sum(0).clamp_min(1e-6)
    return ObjectPoses(
        (poses.position_m * share[..., None]).sum(0),
        (poses.axes * share[..., None, None]).sum(0),
        poses.present.mean(0),
    )


def mean_start(memory: SceneMemory) -> ObjectPoses:
    """Object poses at the start, averaged over members."""
    return mean_poses(memory.start.objects)


def mean_size(memory: SceneMemory) -> Float32[Tensor, "batch objects 2"]:
    """Width and height of the objects as factors of the usual ones, averaged over members."""
    return memory.start.size.mean(0)


def _between(now: ObjectPoses, latents: ObjectPoses) -> ObjectPoses:
    """Poses at every step of the model grid, interpolated linearly between latent steps."""
    weight = torch.arange(1, STEPS_PER_LATENT + 1) / STEPS_PER_LATENT

    def filled(first: Tensor, later: Tensor) -> Tensor:
        before = torch.cat([first[:, None], later[:, :-1]], dim=1)[:, :, None]
        ramp = weight.view(-1, *[1] * (first.ndim - 1))
        return (before + ramp * (later[:, :, None] - before)).flatten(1, 2)

    return ObjectPoses(
        filled(now.position_m, latents.position_m),
        filled(now.axes, latents.axes),
        latents.present.repeat_interleave(STEPS_PER_LATENT, dim=1),
    )


def _resting(memory: SceneMemory, distance: Float32[Tensor, "batch latents"]) -> _Run:
    """Latent steps in which everything stays constant."""
    num_latents = distance.shape[1]

    def held(now: Tensor, count: int) -> Tensor:
        return now[:, None].expand(-1, count, *now.shape[1:])

    steps = num_latents * STEPS_PER_LATENT
    poses = memory.poses
    return _Run(
        ObjectPoses(held(poses.position_m, steps), held(poses.axes, steps),
            held(poses.present, steps)),
        held(memory.tactile_kpa, steps),
        held(memory.disagreement_m, num_latents),
        distance,
        memory.success[..., None].expand(-1, -1, num_latents),
    )  # fmt: skip


def _chosen(at_rest: Bool[Tensor, " batch"], resting: _Run, moving: _Run) -> _Run:
    """Predictions of `resting` for entries at rest and of `moving` for all others."""

    def chosen(held: Tensor, steps: Tensor) -> Tensor:
        return torch.where(at_rest.view(-1, *[1] * (steps.ndim - 1)), held, steps)

    return _Run(
        ObjectPoses(
            chosen(resting.poses.position_m, moving.poses.position_m),
            chosen(resting.poses.axes, moving.poses.axes),
            chosen(resting.poses.present, moving.poses.present),
        ),
        chosen(resting.tactile_kpa, moving.tactile_kpa),
        chosen(resting.disagreement_m, moving.disagreement_m),
        moving.distance,
        torch.where(at_rest[:, None], resting.success, moving.success),
    )
