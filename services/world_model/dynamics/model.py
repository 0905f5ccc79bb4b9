"""Dynamics model: an ensemble of start readers and recurrent cores with one touch codec.

`begin` reads where objects are from one observed step, `advance` imagines what the next commands
do to them and how it feels. All that lasts between chunks is a `SceneMemory`.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor, nn

from dextouch.tactile.layout import NUM_TAXELS, NUM_TIP_TAXELS, split_pads
from services.world_model.dynamics.configuration import STEPS_PER_LATENT, DynamicsConfig
from services.world_model.dynamics.core import (
    MAX_DEVIATION,
    NUM_PADS,
    RecurrentCore,
    SceneFuture,
    SceneStart,
)
from services.world_model.dynamics.features import LOOKS, command_features
from services.world_model.dynamics.hand_motion import HandMotion
from services.world_model.dynamics.objects import ObjectPoses
from services.world_model.dynamics.start_reader import FirstStep, StartReader
from services.world_model.dynamics.touch_codec import TouchCodec

# An object whose probability of being there is below this is not there.
PRESENCE_THRESHOLD = 0.5
# Hands that move less than this between latent steps stand still.
STILL_M = 1e-4
# After this many latent steps of standing still (2 s) everything has come to rest.
REST_LATENTS = 8


def pad_means_kpa(tactile_kpa: Float32[np.ndarray, "*batch 2 320"]) -> np.ndarray:
    """Mean pressure [..., 12] of thumb … little fingertip and palm, left hand, then right."""
    tips, palm = split_pads(tactile_kpa)
    pads = np.concatenate([tips.mean((-1, -2)), palm.mean((-1, -2))[..., None]], axis=-1)
    return pads.reshape(*pads.shape[:-2], NUM_PADS)


@dataclass(frozen=True)
class Commands:
    """Both hands at the looks of each latent step."""

    points_m: Float32[Tensor, "batch latents looks 2 6 3"]
    axes: Float32[Tensor, "batch latents 2 6"]
    joints_rad: Float32[Tensor, "batch latents 2 20"]

    def __len__(self) -> int:
        return self.points_m.shape[1]

    @classmethod
    def of(cls, motions: list[HandMotion]) -> "Commands":
        """Commands of a batch: for each entry the hands over the next 4k steps."""
        looks = np.arange(0, len(motions[0]), STEPS_PER_LATENT)[:, None] + np.array(LOOKS) - 1
        ends = looks[:, -1]
        return cls(
            torch.from_numpy(np.stack([motion.points_m[looks] for motion in motions])),
            torch.from_numpy(np.stack([motion.axes[ends] for motion in motions])),
            torch.from_numpy(np.stack([motion.joints_rad[ends] for motion in motions])),
        )

    @classmethod
    def standing(cls, motions: list[HandMotion]) -> "Commands":
        """The one latent step that a rollout begins with: hands where they are (one step each)."""
        return cls.of([motion[np.zeros(STEPS_PER_LATENT, dtype=np.int64)] for motion in motions])


@dataclass(frozen=True)
class SceneMemory:
    """All that a rollout's dynamics carry from one chunk to the next.

    `start` holds what was read and felt at the first step, member by member; `hidden` the cores'
    states; `poses` where objects are believed now (mean of the members); `points_m` where the hands
    stood when they last moved; `num_still` for how many latent steps they have stood there.
    """

    start: tuple[SceneStart, ...]
    hidden: Float32[Tensor, "members layers batch width"]
    poses: ObjectPoses
    tactile_kpa: Float32[Tensor, "batch 2 320"]
    points_m: Float32[Tensor, "batch 2 6 3"]
    num_still: Int64[Tensor, " batch"]


@dataclass(frozen=True)
class ImaginedSteps:
    """What the ensemble says of the next 4k steps.

    `disagreement_m` is the largest spread (standard deviation over members) of an object's
    position; `distance` how far command features leave the range of training (0: inside);
    `num_moving` counts the latent steps in which hands moved.
    """

    poses: ObjectPoses
    tactile_kpa: Float32[Tensor, "batch steps 2 320"]
    disagreement_m: Float32[Tensor, " batch"]
    distance: Float32[Tensor, " batch"]
    num_moving: Int64[Tensor, " batch"]


class DynamicsMember(nn.Module):
    """One reader with its core."""

    def __init__(self, config: DynamicsConfig) -> None:
        super().__init__()
        self.reader = StartReader(config)
        self.core = RecurrentCore(config)


class DynamicsModel(nn.Module):
    """Members that were trained from different seeds, and the touch codec they share.

    Args:
        config: of every member.
        num_members: of the ensemble, at least one.
    """

    def __init__(self, config: DynamicsConfig, num_members: int = 1) -> None:
        super().__init__()
        self.config = config
        self.codec = TouchCodec(config.touch_channels)
        self.members = nn.ModuleList(DynamicsMember(config) for _ in range(num_members))

    @torch.no_grad()
    def begin(
        self,
        first: FirstStep,
        tactile_kpa: Float32[Tensor, "batch 2 320"],
        standing: Commands,
        commanded: Float32[Tensor, " batch"],
    ) -> SceneMemory:
        """Read the scene of an observed step.

        Args:
            first: the step as readers see it.
            tactile_kpa: pressure of that step.
            standing: from `Commands.standing` of the measured hands.
            commanded: 1 where the rollout's actions are commanded, 0 where they are measured.
        """
        starts, states = [], []
        touch = self.codec.encode(tactile_kpa)
        for member in self._members():
            objects = member.reader(first)
            start = SceneStart(objects, touch, first.pads_kpa, first.task, commanded)
            features = _features(standing, objects)
            _, state = member.core(features, start, member.core.first_state(start))
            starts.append(start)
            states.append(state)
        return SceneMemory(
            start=tuple(starts),
            hidden=torch.stack(states),
            poses=_mean([start.objects for start in starts]),
            tactile_kpa=torch.minimum(tactile_kpa, self.codec.peak_kpa),
            points_m=standing.points_m[:, -1, -1],
            num_still=torch.zeros(len(tactile_kpa), dtype=torch.int64),
        )

    @torch.no_grad()
    def advance(self, memory: SceneMemory, commands: Commands) -> tuple[SceneMemory, ImaginedSteps]:
        """Imagine the steps of some commands.

        Entries whose hands had stood still for two seconds before, and go on doing so, are at rest:
        nothing moves any more, and touch stays as it is.
        """
        futures, states, distances = [], [], []
        for index, member in enumerate(self._members()):
            start = memory.start[index]
            features = _features(commands, start.objects)
            future, state = member.core(features, start, memory.hidden[index])
            futures.append(future)
            states.append(state)
            distances.append(_distance(features, member.core))
        imagined = self._imagined(memory, futures, torch.stack(distances).mean(0))
        still = _stillness(memory, commands)
        imagined = replace(imagined, num_moving=still.num_moving)
        imagined = _rested(imagined, memory, still.at_rest)
        hidden = torch.where(still.at_rest[:, None], memory.hidden, torch.stack(states))
        following = replace(
            memory,
            hidden=hidden,
            poses=imagined.poses[:, -1],
            tactile_kpa=imagined.tactile_kpa[:, -1],
            points_m=still.points_m,
            num_still=still.num_still,
        )
        return following, imagined

    def readers(self) -> list[StartReader]:
        """The start reader of every member."""
        return [member.reader for member in self._members()]

    def _members(self) -> list[DynamicsMember]:
        return [member for member in self.members if isinstance(member, DynamicsMember)]

    def _imagined(
        self, memory: SceneMemory, futures: list[SceneFuture], distance: Tensor
    ) -> ImaginedSteps:
        latents = _mean([future.objects for future in futures])
        positions = torch.stack([future.objects.position_m for future in futures])
        used = latents.present > PRESENCE_THRESHOLD
        spread = positions.std(0, correction=0).norm(dim=-1) * used
        touch = torch.stack([future.touch for future in futures]).mean(0)
        contact = torch.stack([future.contact for future in futures]).mean(0)
        return ImaginedSteps(
            poses=_between(memory.poses, latents),
            tactile_kpa=self.decode_touch(touch, contact).flatten(1, 2),
            disagreement_m=spread.amax((1, 2)),
            distance=distance,
            num_moving=torch.zeros(len(distance), dtype=torch.int64),
        )

    def decode_touch(
        self,
        touch: Float32[Tensor, "*batch 2 channels"],
        contact: Float32[Tensor, "*batch 12"],
    ) -> Float32[Tensor, "*batch 2 320"]:
        """Pressures in kPa; pads that are more likely free than in contact feel nothing."""
        pads = (contact > 0).reshape(*contact.shape[:-1], 2, NUM_PADS // 2)
        tips = pads[..., :5].repeat_interleave(NUM_TIP_TAXELS // 5, dim=-1)
        palm = pads[..., 5:].expand(*pads.shape[:-1], NUM_TAXELS - NUM_TIP_TAXELS)
        return self.codec.decode(touch) * torch.cat([tips, palm], dim=-1)


def _features(commands: Commands, objects: ObjectPoses) -> Float32[Tensor, "batch latents f"]:
    return command_features(commands.points_m, commands.axes, commands.joints_rad, objects)


def _distance(features: Tensor, core: RecurrentCore) -> Float32[Tensor, " batch"]:
    """Mean excess of features over the range that the core sees unclipped."""
    scaled = ((features - core.feature_mean) / core.feature_std).abs()
    return (scaled - MAX_DEVIATION).clamp_min(0.0).mean((1, 2))


def _mean(poses: list[ObjectPoses]) -> ObjectPoses:
    """Mean over members; a member that sees no object has no say about where it is."""
    present = torch.stack([each.present for each in poses])
    share = present / present.sum(0).clamp_min(1e-6)
    return ObjectPoses(
        (torch.stack([each.position_m for each in poses]) * share[..., None]).sum(0),
        (torch.stack([each.axes for each in poses]) * share[..., None, None]).sum(0),
        present.mean(0),
    )


def mean_start(memory: SceneMemory) -> ObjectPoses:
    """Where the members together saw the objects of the start."""
    return _mean([start.objects for start in memory.start])


def _between(now: ObjectPoses, latents: ObjectPoses) -> ObjectPoses:
    """Poses of every step of the model grid, linear between latent steps."""
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


@dataclass(frozen=True)
class _Stillness:
    """Where hands stood when they last moved, for how many latent steps, and who is at rest."""

    points_m: Float32[Tensor, "batch 2 6 3"]
    num_still: Int64[Tensor, " batch"]
    num_moving: Int64[Tensor, " batch"]
    at_rest: Bool[Tensor, " batch"]


def _stillness(memory: SceneMemory, commands: Commands) -> _Stillness:
    """Hands move when they leave the place where they stood, however slowly."""
    stood, num_still = memory.points_m, memory.num_still
    num_moving = torch.zeros_like(num_still)
    for latent in range(len(commands)):
        here = commands.points_m[:, latent, -1]
        moves = (here - stood).norm(dim=-1).amax((-1, -2)) >= STILL_M
        stood = torch.where(moves[:, None, None, None], here, stood)
        num_still = torch.where(moves, 0, num_still + 1)
        num_moving = num_moving + moves
    at_rest = (num_moving == 0) & (memory.num_still >= REST_LATENTS)
    return _Stillness(stood, num_still, num_moving, at_rest)


def _rested(imagined: ImaginedSteps, memory: SceneMemory, at_rest: Tensor) -> ImaginedSteps:
    def held(now: Tensor, steps: Tensor) -> Tensor:
        chosen = at_rest.view(-1, *[1] * now.ndim)
        return torch.where(chosen, now[:, None].expand_as(steps), steps)

    return replace(
        imagined,
        poses=ObjectPoses(
            held(memory.poses.position_m, imagined.poses.position_m),
            held(memory.poses.axes, imagined.poses.axes),
            held(memory.poses.present, imagined.poses.present),
        ),
        tactile_kpa=held(memory.tactile_kpa, imagined.tactile_kpa),
    )
