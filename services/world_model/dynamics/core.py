"""Recurrent core: predicts object motion and touch from commanded hand motion, for all tasks.

A gated recurrent network (Cho et al. 2014) at 3.75 Hz on distances of hand points to objects at
their predicted poses. Layers have weights for every member of an ensemble, whose entries follow
each other on the batch axis: an ensemble costs a rollout about as much as one member.
"""

from dataclasses import dataclass
from itertools import combinations

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn
from torch.nn import functional

from dextouch.schemas import MAX_OBJECTS
from services.world_model.dynamics.features import (
    BOX_AXES,
    MAX_DISTANCE_M,
    NUM_POINTS,
    SAMPLE_OFFSETS,
    SLOT_SIZE,
    STEPS_PER_LATENT,
    Commands,
    DynamicsConfig,
    ObjectPoses,
    compressed,
    rotations,
    slot_features,
)

NUM_PADS = 12
# The contact of a hand's taxels is modelled as a mixture of this many patterns.
NUM_PATTERNS = 48
# Predicted motion of an object by itself in one latent step, per unit of output.
MOVE_M = 0.05
_TURN = 0.3
_SIDES = 2
_SLOT_WIDTH, _HAND_WIDTH = 64, 96
# Of an object: size (6), movability, presence, uncertainty, height, and way from the start (3).
_ABOUT_SIZE = 6 + 1 + 1 + 1 + 1 + 3
# Joints, wrist axes, heights of the points at all samples, wrist velocity (twice scaled), side.
OWN_SIZE = 20 + 6 + len(SAMPLE_OFFSETS) * NUM_POINTS + 2 * 3 + 1
# Of an object at the end: the above, axes, position, and way over the table and upwards.
_END_SIZE = _ABOUT_SIZE + 6 + 3 + 2
_PAIRS = tuple(combinations(range(MAX_OBJECTS), 2))
# Of two objects: offset in the world and in either frame, two of them with their length over the
# table or the plane of the frame, and the cosines between their axes.
_PAIR_SIZE = 3 + 1 + 3 + 1 + 3 + 2
# What does not depend on directions in the world: lengths across and up of an object's way, and
# of a pair the heights, lengths across and cosines.
_FREE_OF_OBJECT, _FREE_OF_PAIR = (_END_SIZE - 2, _END_SIZE - 1), (2, 3, 6, 7, 11, 12)
# At first, objects move with no hand.
_BY_ITSELF = 2.0


@dataclass(frozen=True)
class SceneStart:
    """Inputs of the core at the first step, besides the commands.

    `touch` holds the latents of both hands, `pads_kpa` the mean pressures of the twelve pads (thumb
    … little, palm; left, right); `sd_m` is how uncertain each object's position is, on each axis of
    the table; `size` are factors of its usual width (x and y of its frame) and height (z);
    `commanded` is 1 for commanded actions and 0 for measured ones. `task` selects the objects'
    boxes; `instruction` are the features of the sentence, none for cores that read no instruction.
    """

    objects: ObjectPoses
    sd_m: Float32[Tensor, "*batch objects"]
    size: Float32[Tensor, "*batch objects 2"]
    touch: Float32[Tensor, "*batch 2 channels"]
    pads_kpa: Float32[Tensor, "*batch 12"]
    task: Int64[Tensor, "*batch"]
    commanded: Float32[Tensor, "*batch"]
    instruction: Float32[Tensor, "*batch features"]


@dataclass(frozen=True)
class CoreState:
    """What a core carries between latent steps; `axes` of the predicted poses are orthonormal."""

    hidden: Float32[Tensor, "*batch width"]
    position_m: Float32[Tensor, "*batch objects 3"]
    axes: Float32[Tensor, "*batch objects 2 3"]
    wrist_m: Float32[Tensor, "*batch 2 3"]
    wrist_axes: Float32[Tensor, "*batch 2 6"]


@dataclass(frozen=True)
class SceneFuture:
    """Predictions of the core for every latent step.

    `touch`, `pattern` (mapped by `RecurrentCore.taxels` to contact log odds of each taxel) and
    `contact` (contact log odds of each pad) cover the four steps that end at the latent; `success`
    holds the log odds that the task is done at the end, as seen at the latent.
    """

    objects: ObjectPoses
    touch: Float32[Tensor, "*batch latents 4 2 channels"]
    contact: Float32[Tensor, "*batch latents 4 12"]
    pattern: Float32[Tensor, "*batch latents 4 2 patterns"]
    success: Float32[Tensor, "*batch latents"]


class MemberLinear(nn.Module):
    """A linear layer of every member; initialized as `nn.Linear`."""

    def __init__(self, members: int, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(members, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(members, outputs).uniform_(-bound, bound))

    def forward(self, x: Float32[Tensor, "entries *shape inputs"]) -> Tensor:
        """The outputs [entries, *shape, outputs]."""
        members, inputs, outputs = self.weight.shape
        rows = x.reshape(members, -1, inputs)
        return torch.baddbmm(self.bias[:, None], rows, self.weight).view(*x.shape[:-1], outputs)


class MemberNorm(nn.Module):
    """A layer normalization of the last axis (Ba et al. 2016) of every member."""

    def __init__(self, members: int, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(members, width))
        self.bias = nn.Parameter(torch.zeros(members, width))

    def forward(self, x: Float32[Tensor, "entries width"]) -> Float32[Tensor, "entries width"]:
        """The normalized entries."""
        rows = functional.layer_norm(x, x.shape[-1:]).view(len(self.weight), -1, x.shape[-1])
        return torch.addcmul(self.bias[:, None], rows, self.weight[:, None]).view(x.shape)


class MemberGRU(nn.Module):
    """A gated recurrent cell (Cho et al. 2014) of every member, as `nn.GRUCell`."""

    def __init__(self, members: int, inputs: int, width: int) -> None:
        super().__init__()
        self.input = MemberLinear(members, inputs, 3 * width)
        self.recurrent = MemberLinear(members, width, 3 * width)

    def forward(
        self, x: Float32[Tensor, "entries inputs"], state: Float32[Tensor, "entries width"]
    ) -> Float32[Tensor, "entries width"]:
        """The next state."""
        width = state.shape[-1]
        fresh, kept = self.input(x), self.recurrent(state)
        reset, update = (fresh[:, : 2 * width] + kept[:, : 2 * width]).sigmoid().chunk(2, dim=1)
        new = torch.addcmul(fresh[:, 2 * width :], reset, kept[:, 2 * width :]).tanh()
        return torch.lerp(new, state, update)


class RecurrentCore(nn.Module):
    """Predicts object poses and touch from commands and a start; entries go member by member."""

    boxes_m: Tensor
    movable: Tensor
    lowest: Tensor
    highest: Tensor

    def __init__(self, config: DynamicsConfig, members: int = 1) -> None:
        super().__init__()
        self.config, self.members = config, members
        width, channels = config.width, config.touch_channels

        def linear(inputs: int, outputs: int) -> MemberLinear:
            return MemberLinear(members, inputs, outputs)

        # Not weights: what the objects of each task are.
        tasks = len(config.tasks)
        self.register_buffer("boxes_m", torch.zeros(tasks, MAX_OBJECTS, 6))
        self.register_buffer("movable", torch.zeros(tasks, MAX_OBJECTS))
        self.register_buffer("lowest", torch.full((OWN_SIZE,), -10.0))
        self.register_buffer("highest", torch.full((OWN_SIZE,), 10.0))
        self.slot = nn.Sequential(
            linear(SLOT_SIZE + _ABOUT_SIZE, 128), nn.GELU(),
            linear(128, _SLOT_WIDTH), nn.GELU(),
        )  # fmt: skip
        self.hand = nn.Sequential(linear(_SLOT_WIDTH + OWN_SIZE, _HAND_WIDTH), nn.GELU())
        # Whether actions are commanded, whether a person acts, and the instruction.
        flags = 1 + config.has_humans + config.instruction_size
        self.mix = nn.Sequential(
            linear(_SIDES * _HAND_WIDTH + flags, width), MemberNorm(members, width), nn.GELU()
        )
        self.begin = nn.Sequential(
            linear(NUM_PADS + _SIDES * channels + flags, width), nn.GELU(),
            linear(width, width), nn.Tanh(),
        )  # fmt: skip
        self.memory = MemberGRU(members, width, width)
        self.dropout = nn.Dropout(0.1)
        self.objects = nn.Sequential(
            linear(width + _SIDES * _SLOT_WIDTH + _ABOUT_SIZE + 6, 128), nn.GELU()
        )
        self.feel = nn.Sequential(
            linear(width + _HAND_WIDTH + 1, 160), nn.GELU(), linear(160, 160), nn.GELU()
        )
        self.touch = linear(160, STEPS_PER_LATENT * channels)
        self.contact = linear(160, STEPS_PER_LATENT * (NUM_PADS // _SIDES))
        self.pattern = linear(160, STEPS_PER_LATENT * NUM_PATTERNS)
        self.taxels = linear(NUM_PATTERNS, config.tactile_layout.num_taxels)
        # A person's skin and a robot's differ; where a pad meets an object does not.
        self.human: nn.ModuleDict | None = None
        if config.has_humans:
            touch = linear(160, STEPS_PER_LATENT * channels)
            pattern = linear(160, STEPS_PER_LATENT * NUM_PATTERNS)
            self.human = nn.ModuleDict({"touch": touch, "pattern": pattern})
        self.success = nn.Sequential(
            linear(width + MAX_OBJECTS * _END_SIZE + len(_PAIRS) * _PAIR_SIZE, 128), nn.GELU(),
            nn.Dropout(0.2), linear(128, 1),
        )  # fmt: skip
        self.motion = linear(128, 3 + 3 + 6)
        nn.init.zeros_(self.motion.weight)
        with torch.no_grad():
            self.motion.bias.copy_(torch.tensor([0.0, 0.0, _BY_ITSELF, *[0.0] * 9]))

    @torch.no_grad()
    def distance(
        self, commands: Commands, before_m: Float32[Tensor, "batch 2 3"]
    ) -> Float32[Tensor, "batch latents"]:
        """Mean excess of the hands' features over their range in training, from `before_m` on."""
        wrist_m = torch.cat([before_m[:, None], commands.points_m[:, :, -1, :, 0]], dim=1)
        own = own_features(commands, wrist_m)
        beyond = (own - self.highest).clamp_min(0.0) + (self.lowest - own).clamp_min(0.0)
        return beyond.mean((2, 3))

    def used_slots(self, task: Int64[Tensor, " batch"]) -> int:
        """Largest number of objects of the entries of a batch."""
        return max(self.config.num_objects[index] for index in task.tolist())

    def _flags(self, start: SceneStart, human: Tensor | None) -> Float32[Tensor, "batch flags"]:
        flags = [start.commanded[:, None]]
        if self.config.has_humans:
            flags.append(torch.zeros_like(flags[0]) if human is None else human[:, None])
        if self.config.instructions:
            flags.append(start.instruction)
        return torch.cat(flags, dim=1)

    def first_state(
        self, start: SceneStart, holding: Commands, human: Float32[Tensor, " batch"] | None = None
    ) -> CoreState:
        """The state before the first step, with the measured hands as one latent step.

        `human` is 1 where a person acts, 0 for robots; None for robots alone, as in rollouts.
        """
        flags = self._flags(start, human)
        known = [compressed(start.pads_kpa * 1e-2), start.touch.flatten(1), flags]
        return CoreState(
            self.begin(torch.cat(known, dim=1)),
            start.objects.position_m,
            rotations(start.objects.axes)[..., [2, 0]].transpose(-1, -2),
            holding.points_m[:, -1, -1, :, 0],
            holding.axes[:, -1],
        )

    def forward(
        self,
        commands: Commands,
        start: SceneStart,
        state: CoreState,
        human: Float32[Tensor, " batch"] | None = None,
    ) -> tuple[SceneFuture, CoreState]:
        """Predictions for every latent, and the state after the last one.

        `state` is from `first_state`, as is `human`, or from the previous chunk; `start` stays the
        same.
        """
        flags = self._flags(start, human)
        # Slots that no entry of the batch uses need no computation.
        counts = torch.tensor(self.config.num_objects)[start.task]
        used = self.used_slots(start.task)
        there = start.objects.present * (torch.arange(MAX_OBJECTS) < counts[:, None])
        present = there[:, :used]
        first_m = start.objects.position_m[:, :used]
        box = self.boxes_m[start.task, :used] * start.size[:, :used, BOX_AXES]
        moves = self.movable[start.task, :used] * present
        spread = 5.0 * compressed(start.sd_m[:, :used])
        known = torch.cat([box * 10.0, torch.stack([moves, present, spread], dim=-1)], dim=-1)
        wrist_m = torch.cat([state.wrist_m[:, None], commands.points_m[:, :, -1, :, 0]], dim=1)
        R = _rotation(torch.cat([state.wrist_axes[:, None], commands.axes], dim=1))
        turn = R[:, 1:] @ R[:, :-1].transpose(-1, -2)
        own = own_features(commands, wrist_m)
        hidden = state.hidden
        position, R_object = state.position_m[:, :used], rotations(state.axes[:, :used])
        steps: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []
        for latent in range(len(commands)):
            height, way = compressed(position[..., 2:]), (position - first_m) * 5.0
            about = torch.cat([known, height, way], dim=-1)
            seen = slot_features(commands.points_m[:, latent], position, R_object, box)
            each = about[:, None].expand(-1, _SIDES, -1, -1)
            slots = self.slot(torch.cat([seen, each], dim=-1)) * present[:, None, :, None]
            hands = self.hand(torch.cat([slots.sum(2), own[:, latent]], dim=-1))
            mixed = self.mix(torch.cat([hands.flatten(1), flags], dim=1))
            hidden = self.memory(self.dropout(mixed), hidden)
            of_hands = (hidden[:, None].expand(-1, used, -1), slots.transpose(1, 2).flatten(2))
            near = torch.cat([*of_hands, about, R_object[..., 2], R_object[..., 0]], dim=-1)
            position, R_object = _moved(
                (position, R_object),
                self.motion(self.objects(near)),
                moves,
                (wrist_m[:, latent], wrist_m[:, latent + 1], turn[:, latent]),
            )
            steps.append((hidden, hands, position, R_object, about))
        stacked = [torch.stack(parts, dim=1) for parts in zip(*steps, strict=True)]
        future = self._decoded(stacked, there, start.objects.position_m, human)
        at_end = future.objects[:, -1]
        return future, CoreState(
            hidden, at_end.position_m, at_end.axes, wrist_m[:, -1], commands.axes[:, -1]
        )

    def _decoded(
        self,
        steps: list[Tensor],
        there: Float32[Tensor, "batch objects"],
        first_m: Float32[Tensor, "batch objects 3"],
        human: Float32[Tensor, " batch"] | None,
    ) -> SceneFuture:
        hidden, hands, position, R_object, about = steps
        axes = torch.stack([R_object[..., 2], R_object[..., 0]], dim=-2)
        empty = MAX_OBJECTS - position.shape[2]
        position = functional.pad(position, (0, 0, 0, empty))
        axes = functional.pad(axes, (0, 0, 0, 0, 0, empty))
        about = functional.pad(about, (0, 0, 0, empty))
        side = torch.tensor([-1.0, 1.0])[:, None].expand(*hands.shape[:-1], 1)
        each = hidden[:, :, None].expand(-1, -1, _SIDES, -1)
        felt = self.feel(torch.cat([each, hands, side], dim=-1))
        pads = self.contact(felt).unflatten(-1, (STEPS_PER_LATENT, NUM_PADS // _SIDES))
        touch, pattern = self.touch(felt), self.pattern(felt)
        if self.human is not None and human is not None:
            by_person = human.view(-1, 1, 1, 1) > 0
            touch = torch.where(by_person, self.human["touch"](felt), touch)
            pattern = torch.where(by_person, self.human["pattern"](felt), pattern)
        touch = touch.unflatten(-1, (STEPS_PER_LATENT, self.config.touch_channels))
        pattern = pattern.unflatten(-1, (STEPS_PER_LATENT, NUM_PATTERNS))
        present = there[:, None].expand(-1, hidden.shape[1], -1)
        ends = _ending_features(position, axes, about, present, position - first_m[:, None])
        return SceneFuture(
            ObjectPoses(position, axes, present),
            touch.transpose(2, 3),
            pads.transpose(2, 3).flatten(3),
            pattern.transpose(2, 3),
            self.success(torch.cat([hidden, ends], dim=-1))[..., 0],
        )


def direction_free_inputs(width: int) -> list[int]:
    """Inputs of the estimate of success that are lengths, heights and angles, by a core's width."""
    of_pairs = width + MAX_OBJECTS * _END_SIZE
    of_objects = range(width, of_pairs, _END_SIZE)
    pairs = range(of_pairs, of_pairs + len(_PAIRS) * _PAIR_SIZE, _PAIR_SIZE)
    return [first + index for first in of_objects for index in _FREE_OF_OBJECT] + [
        first + index for first in pairs for index in _FREE_OF_PAIR
    ]


def own_features(
    commands: Commands, wrist_m: Float32[Tensor, "batch following 2 3"]
) -> Float32[Tensor, "batch latents 2 own"]:
    """What is known of each hand without objects."""
    velocity = wrist_m[:, 1:] - wrist_m[:, :-1]
    heights = compressed(commands.points_m[..., 2]).transpose(2, 3).flatten(3)
    side = torch.tensor([-1.0, 1.0])[:, None].expand(*velocity.shape[:-1], 1)
    parts = [commands.joints_rad, commands.axes, heights, 20 * velocity, compressed(velocity), side]
    return torch.cat(parts, dim=-1)


def _rotation(columns: Float32[Tensor, "*batch 6"]) -> Float32[Tensor, "*batch 3 3"]:
    x, y = columns[..., :3], columns[..., 3:]
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def _moved(
    poses: tuple[Tensor, Tensor],
    output: Float32[Tensor, "batch objects outputs"],
    moves: Float32[Tensor, "batch objects"],
    wrists: tuple[Tensor, Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Poses after a latent step, moved with the hands as the gates say, and by themselves."""
    position, R = poses
    before_m, after_m, turn = wrists
    share = output[..., :3].softmax(-1)[..., :2].transpose(1, 2)[..., None]
    arm = position[:, None] - before_m[:, :, None]
    with_hands = torch.einsum("bhij,bhsj->bhsi", turn, arm) + after_m[:, :, None]
    step = (share * (with_hands - position[:, None])).sum(1) + MOVE_M * output[..., 3:6]
    moved = position + moves[..., None] * step
    turned = torch.einsum("bhij,bsjk->bhsik", turn, R)
    change = (share[..., None] * (turned - R[:, None])).sum(1)
    own = _TURN * output[..., 6:12]
    z = functional.normalize(R[..., 2] + moves[..., None] * (change[..., 2] + own[..., :3]), dim=-1)
    x = R[..., 0] + moves[..., None] * (change[..., 0] + own[..., 3:])
    x = functional.normalize(x - z * (x * z).sum(-1, keepdim=True), dim=-1)
    after = torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)
    return moved.clamp(-MAX_DISTANCE_M, MAX_DISTANCE_M), after


def _ending_features(
    position: Float32[Tensor, "batch latents objects 3"],
    axes: Float32[Tensor, "batch latents objects 2 3"],
    about: Float32[Tensor, "batch latents objects size"],
    present: Float32[Tensor, "batch latents objects"],
    way: Float32[Tensor, "batch latents objects 3"],
) -> Float32[Tensor, "batch latents features"]:
    """Poses of all objects, and of each pair relative to each other.

    A task mostly asks for a distance or an angle between objects; given so, few takes teach it.
    """
    z, x = axes.unbind(-2)
    R = torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)
    lengths = torch.cat([way[..., :2].norm(dim=-1, keepdim=True), way[..., 2:]], dim=-1)
    each = [about, axes.flatten(3), compressed(position), compressed(lengths)]
    parts = [(torch.cat(each, dim=-1) * present[..., None]).flatten(2)]
    for a, b in _PAIRS:
        a_to_b = position[..., b, :] - position[..., a, :]
        from_a, from_b = (
            torch.einsum("bli,blij->blj", offset, R[..., index, :, :])
            for offset, index in ((a_to_b, a), (-a_to_b, b))
        )
        cosines = [(one[..., a, :] * one[..., b, :]).sum(-1, keepdim=True) for one in (z, x)]
        distances = [_with_length_across(a_to_b), _with_length_across(from_a), compressed(from_b)]
        there = present[..., a, None] * present[..., b, None]
        parts.append(torch.cat([*distances, *cosines], dim=-1) * there)
    return torch.cat(parts, dim=-1)


def _with_length_across(offset_m: Float32[Tensor, "*batch 3"]) -> Float32[Tensor, "*batch 4"]:
    return compressed(torch.cat([offset_m, offset_m[..., :2].norm(dim=-1, keepdim=True)], dim=-1))
