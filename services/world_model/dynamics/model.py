"""Dynamics model: an ensemble of start readers and recurrent cores that share a touch codec."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from torch import Tensor, nn

from dextouch.errors import InvalidInputError, NonFiniteError
from dextouch.schemas import MAX_OBJECTS
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.world_model.dynamics.core import NUM_PADS, CoreState, RecurrentCore, SceneStart
from services.world_model.dynamics.features import (
    FREE_KPA,
    NUM_POINTS,
    SIZE_RANGE,
    STEPS_PER_LATENT,
    Commands,
    DynamicsConfig,
    HandMotion,
    ObjectPoses,
    TouchCodec,
)
from services.world_model.dynamics.start_reader import FirstStep, Reading, StartReader
from services.world_model.dynamics.tensor_trees import (
    Part,
    Traced,
    by_name,
    chosen,
    folded,
    mapped,
    named,
    stacked,
    unfolded,
)

# Objects with a lower presence probability count as absent.
PRESENCE_THRESHOLD = 0.5
# Contact threshold of a taxel: probability 0.35. Where contact cannot be predicted with certainty,
# the threshold with the best F1 is half of that F1 (Lipton et al. 2014).
CONTACT_LOG_ODDS = -0.62
# Hands that move less than this between latent steps count as still.
STILL_M = 1e-4
# After this many still latent steps (2 s) the scene counts as settled.
REST_LATENTS = 8
# Bound on metres, kilopascals and latents; this world never writes larger values.
_LARGEST = 1e6
# What every member knows has the axes members, batch, …; all else begins with the batch.
_OF_MEMBERS = ("start", "state", "success")
# Ranges within which this world writes values.
_RANGES = {
    "start.size": SIZE_RANGE,
    "state.hidden": (-1.0, 1.0),
    "state.position_m": (-1.0, 1.0),
    "state.axes": (-1.0, 1.0),
    "state.wrist_axes": (-1.0, 1.0),
    "success": (0.0, 1.0),
}


@dataclass(frozen=True)
class Stillness:
    """Latent steps in which hands move or the scene rests; `points_m` when they last moved."""

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
    commanded_m: Float32[Tensor, "batch latents samples 2 points 3"],
) -> Stillness:
    """Track hands that have stood at `points_m` for `num_still` latent steps.

    Hands move when they leave that position, however slowly. A scene is at rest in latent steps
    without motion that follow `REST_LATENTS` such steps, however commands are split into chunks.
    """
    moved, rested = [], []
    for samples_m in commanded_m.unbind(1):
        off_m = (samples_m - points_m[:, None]).norm(dim=-1).amax((-1, -2, -3))
        moves = off_m >= STILL_M
        rested.append(~moves & (num_still >= REST_LATENTS))
        moved.append(moves)
        points_m = torch.where(moves[:, None, None, None], samples_m[:, -1], points_m)
        num_still = torch.where(moves, 0, num_still + 1)
    return Stillness(points_m, num_still, torch.stack(moved, 1), torch.stack(rested, 1))


def by_pad(
    tactile_kpa: Float[np.ndarray, "*batch 2 taxels"],
    reduce: Callable[..., np.ndarray],
    layout: TactileLayout = DEXTOUCH_V1,
) -> Float[np.ndarray, "*batch 12"]:
    """One pressure a pad: thumb … little fingertip and palm of the left hand, then of the right.

    `reduce` takes taxels and an axis, such as `np.mean`; a part of the hand without taxels has 0.
    """
    return layout.by_part(tactile_kpa, reduce).reshape(*tactile_kpa.shape[:-2], NUM_PADS)


def first_steps(
    images: Sequence[UInt8[np.ndarray, "px px 3"]],
    Ks_head: Sequence[Float64[np.ndarray, "3 3"]],
    tactile_kpa: Sequence[Float32[np.ndarray, "2 taxels"]],
    hands: Sequence[HandMotion],
    tasks: Sequence[int],
    layout: TactileLayout = DEXTOUCH_V1,
) -> FirstStep:
    """A batch of observed steps as inputs of the readers; `hands` are of one step each."""
    return FirstStep(
        torch.from_numpy(np.stack(images)),
        torch.from_numpy(np.stack(Ks_head)).float(),
        torch.from_numpy(np.concatenate([one.Ts_world_camera for one in hands])).float(),
        torch.from_numpy(np.concatenate([one.points_m for one in hands])),
        torch.from_numpy(by_pad(np.stack(tactile_kpa), np.mean, layout)),
        torch.tensor(tasks),
    )


@dataclass(frozen=True)
class SceneMemory:
    """State of the dynamics that a rollout carries from one chunk to the next.

    `start` holds objects and touch at the first step as every member knows them, `state` the state
    of every member's core (both with axes members, batch, …), `poses` the current object poses
    (mean over members), `disagreement_m` the largest spread of a position, `success` the members'
    probability that the task is done at the end, `points_m` the hand points when they last moved,
    `num_still` the latent steps since then (`REST_LATENTS` at first for hands that touch nothing).
    """

    start: SceneStart
    state: CoreState
    poses: ObjectPoses
    disagreement_m: Float32[Tensor, " batch"]
    tactile_kpa: Float32[Tensor, "batch 2 taxels"]
    success: Float32[Tensor, "members batch"]
    points_m: Float32[Tensor, "batch 2 points 3"]
    num_still: Int64[Tensor, " batch"]


@dataclass(frozen=True)
class _Run:
    poses: ObjectPoses
    tactile_kpa: Float32[Tensor, "batch steps 2 taxels"]
    disagreement_m: Float32[Tensor, "batch latents"]
    distance: Float32[Tensor, "batch latents"]
    success: Float32[Tensor, "members batch latents"]


@dataclass(frozen=True)
class ImaginedSteps(_Run):
    """Predictions of the ensemble for the next 4k steps and the k latent steps they form.

    `disagreement_m` is the largest standard deviation over members of an object's position;
    `distance` is how far the hands' motion lies outside the range of training (0: inside);
    `success` is the probability of every member that the task is done at the end; `moves` marks
    latents in which hands move, `at_rest` those in which nothing moves any more.
    """

    moves: Bool[Tensor, "batch latents"]
    at_rest: Bool[Tensor, "batch latents"]


class DynamicsModel(nn.Module):
    """Ensemble of start readers and cores from different seeds, with a shared touch codec."""

    def __init__(self, config: DynamicsConfig, num_members: int = 1) -> None:
        super().__init__()
        self.config = config
        self.codec = TouchCodec(config.touch_channels, config.tactile_layout.num_taxels)
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
        tactile_kpa: Float32[Tensor, "batch 2 taxels"],
        holding: Commands,
        commanded: Float32[Tensor, " batch"],
        instruction: Float32[Tensor, "batch features"],
    ) -> SceneMemory:
        """Estimate the scene at an observed step.

        If the hands touch nothing, the scene is at rest until they move. `holding` are the measured
        hands, from `Commands.holding`, and `instruction` the features of the sentence; `commanded`
        is 1 if the rollout's actions are commanded, 0 if they are measured.
        """
        known = (self.codec.encode(tactile_kpa), first.pads_kpa, first.task, commanded, instruction)
        readings: list[Reading] = [reader(first) for reader in self.readers()]
        start = stacked([SceneStart(one.objects, one.sd_m, one.size, *known) for one in readings])
        each, still = folded(start), holding.repeated(self.core.members)
        future, state = self.core(still, each, self.core.first_state(each, still))
        return SceneMemory(
            start=start,
            state=unfolded(state, self.core.members),
            poses=mean_poses(start.objects),
            disagreement_m=_spread_m(start.objects),
            tactile_kpa=torch.minimum(tactile_kpa, self.codec.peak_kpa),
            success=unfolded(future, self.core.members).success[..., -1].sigmoid(),
            points_m=holding.points_m[:, -1, -1],
            num_still=REST_LATENTS * (tactile_kpa.amax((1, 2)) < FREE_KPA).long(),
        )

    @torch.no_grad()
    def advance(self, memory: SceneMemory, commands: Commands) -> tuple[SceneMemory, ImaginedSteps]:
        """Predict the steps that follow from commands, however they are split over calls.

        Poses and touch stay constant where hands have stood still for two seconds, and still do.
        """
        still = stillness(memory.points_m, memory.num_still, commands.points_m)
        parts: list[_Run] = []
        for latents, at_rest in still.runs():
            memory, part = self._advance_run(memory, commands[latents], at_rest)
            parts.append(part)
        following = replace(memory, points_m=still.points_m, num_still=still.num_still)
        whole = named(parts, lambda name, each: torch.cat(each, dim=1 + _batch_axis(name)))
        return following, ImaginedSteps(**vars(whole), moves=still.moves, at_rest=still.at_rest)

    def _advance_run(
        self, memory: SceneMemory, commands: Commands, at_rest: Bool[Tensor, " batch"]
    ) -> tuple[SceneMemory, "_Run"]:
        """Advance by latent steps during which the same entries are at rest."""
        if bool(at_rest.all()):
            # The wrists are where they were commanded to be, for all members.
            return memory, _resting(memory, self.core.distance(commands, memory.state.wrist_m[0]))
        state, run = self._predict(commands, memory.start, memory.state, memory.poses)
        if bool(at_rest.any()):
            run = named(
                [_resting(memory, run.distance), run],
                lambda name, pair: torch.where(
                    at_rest.view(-1, *[1] * (pair[0].ndim - 1 - _batch_axis(name))),
                    pair[0],
                    pair[1],
                ),
            )
            members = self.core.members
            kept = chosen(at_rest.repeat(members), folded(memory.state), folded(state))
            state = unfolded(kept, members)
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
        each = unfolded(future, members)
        taxels = self.core.taxels(future.pattern).view(*each.pattern.shape[:-1], -1)
        run = _Run(
            poses=_between(poses, mean_poses(each.objects)),
            tactile_kpa=self.decode_touch(each.touch.mean(0), taxels.mean(0)).flatten(1, 2),
            disagreement_m=_spread_m(each.objects),
            distance=self.core.distance(commands, state.wrist_m[0]),
            success=each.success.sigmoid(),
        )
        return unfolded(after, members), run

    def _kind_of(self, commands: Commands, start: SceneStart, *_: object) -> tuple[int, int, int]:
        """Latent steps, entries of the batch, and the slots that some entry uses."""
        return len(commands), start.task.shape[1], self.core.used_slots(start.task[0])

    def readers(self) -> list[StartReader]:
        """The start reader of every member."""
        return [reader for reader in self.eyes if isinstance(reader, StartReader)]

    def decode_touch(
        self,
        touch: Float32[Tensor, "*batch 2 channels"],
        taxels: Float32[Tensor, "*batch 2 taxels"],
    ) -> Float32[Tensor, "*batch 2 taxels"]:
        """Pressures (kPa): of taxels in contact at least the contact threshold, of others 0."""
        touches = taxels > CONTACT_LOG_ODDS
        return self.codec.decode(touch).clamp_min(CONTACT_THRESHOLD_KPA) * touches


def _spread_m(poses: ObjectPoses) -> Float32[Tensor, "*batch"]:
    """Largest standard deviation over members of the position of a present object."""
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
    num_latents = distance.shape[1]

    def held(now: Tensor, count: int) -> Tensor:
        return now[:, None].expand(-1, count, *now.shape[1:])

    steps = num_latents * STEPS_PER_LATENT
    return _Run(
        mapped(memory.poses, lambda now: held(now, steps)),
        held(memory.tactile_kpa, steps),
        held(memory.disagreement_m, num_latents),
        distance,
        memory.success[..., None].expand(-1, -1, num_latents),
    )


def batched(parts: Sequence[Part]) -> Part:
    """One batch of several memories, or of what was imagined with them."""
    return named(parts, lambda name, each: torch.cat(each, dim=_batch_axis(name)))


def memory_of(memory: SceneMemory, index: int) -> SceneMemory:
    """Memory of one rollout of a batch."""
    # Copies: a slice would keep the whole batch alive and share it with other rollouts.
    one = torch.tensor([index])
    return named([memory], lambda name, parts: parts[0].index_select(_batch_axis(name), one))


def _batch_axis(name: str) -> int:
    return int(name.partition(".")[0] in _OF_MEMBERS)


def memory_arrays(memory: SceneMemory) -> dict[str, np.ndarray]:
    """Arrays of a single rollout's memory, for a snapshot."""
    # Models that read no instruction have none in their snapshots.
    arrays = {name: value.contiguous().numpy() for name, value in by_name(memory).items()}
    return {name: array for name, array in arrays.items() if array.size}


def memory_from_arrays(
    arrays: Mapping[str, np.ndarray], config: DynamicsConfig, num_members: int
) -> SceneMemory:
    """Inverse of `memory_arrays`; validates untrusted arrays.

    Raises:
        InvalidInputError: missing arrays, wrong shapes or dtypes, or an unknown task.
        NonFiniteError: NaN or infinity.
    """
    memory = named(
        [_empty(config, num_members)], lambda name, parts: _checked(name, arrays, parts[0])
    )
    task = memory.start.task
    if not bool(((task >= 0) & (task < len(config.tasks)) & (task == task[0, 0])).all()):
        raise InvalidInputError(
            f"snapshot: got task numbers {task.flatten().tolist()}, expected one of 0 … "
            f"{len(config.tasks) - 1} for all members"
        )
    return memory


def _empty(config: DynamicsConfig, members: int) -> SceneMemory:
    """The memory of one rollout with zeros: names, shapes and types of a snapshot."""
    objects, zeros = MAX_OBJECTS, torch.zeros

    def poses(*batch: int) -> ObjectPoses:
        sizes = (objects, 3), (objects, 2, 3), (objects,)
        return ObjectPoses(*(zeros(*batch, *size) for size in sizes))

    start = SceneStart(
        objects=poses(members, 1),
        sd_m=zeros(members, 1, objects),
        size=zeros(members, 1, objects, 2),
        touch=zeros(members, 1, 2, config.touch_channels),
        pads_kpa=zeros(members, 1, NUM_PADS),
        task=zeros(members, 1, dtype=torch.int64),
        commanded=zeros(members, 1),
        instruction=zeros(members, 1, config.instruction_size),
    )
    state = CoreState(
        hidden=zeros(members, 1, config.width),
        position_m=zeros(members, 1, objects, 3),
        axes=zeros(members, 1, objects, 2, 3),
        wrist_m=zeros(members, 1, 2, 3),
        wrist_axes=zeros(members, 1, 2, 6),
    )
    return SceneMemory(
        start=start,
        state=state,
        poses=poses(1),
        disagreement_m=zeros(1),
        tactile_kpa=zeros(1, 2, config.tactile_layout.num_taxels),
        success=zeros(members, 1),
        points_m=zeros(1, 2, NUM_POINTS, 3),
        num_still=zeros(1, dtype=torch.int64),
    )


def _checked(name: str, arrays: Mapping[str, np.ndarray], expected: Tensor) -> Tensor:
    """One array of a snapshot as a tensor, within the range of what this world writes."""
    array, like = arrays.get(name), expected.numpy()
    if not like.size:
        return expected
    if array is None or array.shape != like.shape or array.dtype != like.dtype:
        got = "nothing" if array is None else f"{array.dtype.name} {array.shape}"
        raise InvalidInputError(
            f"snapshot: {name} is {got}, expected {like.dtype.name} {like.shape} of this world's "
            "own snapshot"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise NonFiniteError(f"snapshot: {name} contains NaN or infinity")
    if array.dtype.kind == "f" and (largest := np.abs(array).max()) > _LARGEST:
        raise InvalidInputError(
            f"snapshot: {name} has values up to {largest:.3g}, expected at most {_LARGEST:.0e}"
        )
    found = torch.from_numpy(np.array(array))
    return found.clamp(*_RANGES[name]) if name in _RANGES else found
