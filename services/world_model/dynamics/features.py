"""What the dynamics read and predict: configuration, commands, words, hands, objects and touch."""

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from operator import not_
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Shaped
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional

from dextouch.frozen_model import FrozenModel
from dextouch.geometry import pose_from_transform, transform, transform_from_pose
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, AnchorPoses, poses_from_actions
from dextouch.hands.robot_hand import chain_points_of_both_m
from dextouch.schemas import MAX_OBJECTS, Domain
from dextouch.tactile import MAX_CELLS
from dextouch.tactile.layout import DEXTOUCH_V1, NUM_TAXELS, TactileLayout
from services.world_model.dynamics.tensor_trees import mapped

# Of each hand: the wrist, five fingertips, five PIP joints, and the middle of the palm.
NUM_POINTS: Final = 12
NEAR_M = 0.01
# Features are computed at these of the four steps of a latent: hands may shake within one.
SAMPLE_OFFSETS = (1, 2, 3, 4)
# The wrist is left out: it touches nothing.
_FIRST_POINT = 1
_PER_POINT = 7
SLOT_SIZE = len(SAMPLE_OFFSETS) * (NUM_POINTS - _FIRST_POINT) * _PER_POINT
# The core runs once every four steps of the model grid, the rate of video latents.
STEPS_PER_LATENT: Final = 4
# What models of older releases know.
_ROBOT_ALONE: Final[tuple[Domain, ...]] = ("robot",)
# Objects farther than this from the world's origin count as absent.
MAX_DISTANCE_M = 1.0
# Factors of the usual size that an object may have.
SIZE_RANGE = (0.5, 2.0)
# Which factor, width or height, each number of a box has: middle, half sizes; x, y, z.
BOX_AXES = [0, 0, 1, 0, 0, 1]
# Shorter axes have no direction.
_SHORTEST = 1e-3
# Pads with a lower peak pressure count as free when contact is learned.
FREE_KPA = 2.0
# Chosen: a sentence has some 60 subwords, and few of them tell it from another one.
_INSTRUCTION_SIZE = 64
_SIGN_BIT = 1 << 31
# Trigrams of at most 24 words of average length.
MAX_SUBWORDS: Final = 160
WORD: Final = re.compile(r"\w+")
# No channel is scaled up by more than sqrt(1 / this) relative to the strongest one.
MIN_RELATIVE_SCALE: Final = 1e-3


@dataclass(frozen=True)
class HandMotion:
    """Both hands over n steps in the world frame, left before right.

    `points_m` are the wrist, thumb … little fingertip, their PIP joints, and a point halfway
    between the wrist and the knuckles; `axes` the first two columns of R_world_wrist;
    `Ts_world_camera` the head camera's poses.
    """

    points_m: Float32[np.ndarray, "n 2 12 3"]
    axes: Float32[np.ndarray, "n 2 6"]
    joints_rad: Float32[np.ndarray, "n 2 20"]
    Ts_world_camera: Float64[np.ndarray, "n 4 4"]

    def __len__(self) -> int:
        return len(self.points_m)

    def __getitem__(self, steps: slice | np.ndarray) -> "HandMotion":
        """Select steps."""
        return HandMotion(*(values[steps] for values in vars(self).values()))


def hand_motion(
    actions: Float64[np.ndarray, "n 67"], anchor: AnchorPoses, *, validated: bool = False
) -> HandMotion:
    """Motion of both hands under actions relative to `anchor`, which may be `validated` already.

    Raises:
        DegenerateRotationError: the actions contain a degenerate rotation.
    """
    poses = poses_from_actions(actions, anchor, validated=validated)
    Ts = np.stack([poses.Ts_world_wrist_left, poses.Ts_world_wrist_right], axis=1)
    joints = np.stack([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1)
    chains = chain_points_of_both_m(joints)
    knuckles, pips, tips = chains[..., 0, :], chains[..., 1, :], chains[..., 3, :]
    palm = 0.5 * knuckles[:, :, 1:].mean(axis=2, keepdims=True)
    R = Ts[..., :3, :3]
    points = np.concatenate([np.zeros_like(palm), tips, pips, palm], axis=2)
    points = points @ np.swapaxes(R, -1, -2) + Ts[:, :, None, :3, 3]
    axes = np.concatenate([R[..., 0], R[..., 1]], axis=-1)
    return HandMotion(
        points.astype(np.float32),
        axes.astype(np.float32),
        joints.astype(np.float32),
        poses.Ts_world_camera_head,
    )


def compressed(distance_m: Float32[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """asinh(d / 1 cm) / 2: linear near zero, where success is decided, logarithmic far away."""
    return torch.asinh(distance_m / NEAR_M) / 2


def slot_features(
    points_m: Float32[Tensor, "batch samples 2 points 3"],
    position_m: Float32[Tensor, "batch objects 3"],
    R: Float32[Tensor, "batch objects 3 3"],
    boxes_m: Float32[Tensor, "batch objects 6"],
) -> Float32[Tensor, "batch 2 objects features"]:
    """Features of each hand and object at one latent step.

    For each point at the `SAMPLE_OFFSETS`: its distance to the object's box, negative inside; its
    offset from the box's middle, in the object's frame; its offset from the object, in the world's.
    `position_m` and `R` are the poses of the objects in the world, `boxes_m` the middle and half
    sizes of each object's box in its frame.
    """
    points_m = points_m[..., _FIRST_POINT:, None, :]
    offset = points_m - position_m[:, None, None, None]
    boxes = boxes_m[:, None, None, None]
    middle, half = boxes[..., :3], boxes[..., 3:]
    from_middle = torch.einsum("blhpsi,bsij->blhpsj", offset, R) - middle
    beyond = from_middle.abs() - half
    distance = beyond.clamp_min(0.0).norm(dim=-1, keepdim=True)
    distance = distance + beyond.amax(-1, keepdim=True).clamp_max(0.0)
    each = compressed(torch.cat([distance, from_middle, offset], dim=-1))
    return each.permute(0, 2, 4, 1, 3, 5).flatten(3)


class DynamicsConfig(FrozenModel):
    """Architecture of a dynamics model, stored in its checkpoints.

    A task's index in `tasks` selects its embedding, and its objects fill the first slots in the
    order of the episode's `object_names`. With the domain `human`, cores are given whose hands act,
    and have heads for the touch of either. With `instructions`, the sentences of training, cores
    read the instruction of a rollout. `layout` is that of the taxels, None of `dextouch_v1`.
    """

    tasks: tuple[str, ...] = Field(min_length=1)
    num_objects: tuple[int, ...]
    image_px: int = Field(default=64, ge=16, le=256)
    reader_channels: int = Field(default=32, ge=8, le=256)
    reader_keypoints: int = Field(default=40, ge=4, le=256)
    width: int = Field(default=192, ge=8, le=1024)
    touch_channels: int = Field(default=96, ge=1, le=MAX_CELLS)
    domains: tuple[Domain, ...] = Field(
        default=_ROBOT_ALONE, exclude_if=lambda domains: domains == _ROBOT_ALONE
    )
    instructions: tuple[str, ...] = Field(default=(), exclude_if=not_)
    layout: TactileLayout | None = Field(default=None, exclude_if=lambda layout: layout is None)

    @property
    def tactile_layout(self) -> TactileLayout:
        """Layout of the taxels that the model feels."""
        return DEXTOUCH_V1 if self.layout is None else self.layout

    @property
    def instruction_size(self) -> int:
        """Size of `instruction_features`; 0 of cores that read no instruction."""
        return _INSTRUCTION_SIZE if self.instructions else 0

    @property
    def has_humans(self) -> bool:
        """Whether cores tell people from robots."""
        return "human" in self.domains

    @model_validator(mode="after")
    def _objects_fit(self) -> "DynamicsConfig":
        if len(self.num_objects) != len(self.tasks) or len(set(self.tasks)) != len(self.tasks):
            raise ValueError(
                f"got {len(self.tasks)} tasks and {len(self.num_objects)} numbers of objects, "
                "expected one number for every task and no task twice"
            )
        num_taxels = self.tactile_layout.num_taxels
        if self.touch_channels > num_taxels:
            raise ValueError(
                f"touch_channels: got {self.touch_channels}, expected at most {num_taxels}, the "
                f"taxels of layout {self.tactile_layout.name!r}"
            )
        if any(not 1 <= count <= MAX_OBJECTS for count in self.num_objects):
            raise ValueError(
                f"num_objects: got {self.num_objects}, expected 1 … {MAX_OBJECTS} for every task"
            )
        return self


def subwords(instruction: str) -> list[str]:
    """Each word and its trigrams, which words of one stem share, in lower case; at most 160."""
    parts = []
    for word in WORD.findall(instruction.lower()):
        marked = f"<{word}>"
        parts += [marked, *(marked[i : i + 3] for i in range(len(marked) - 2))]
    return parts[:MAX_SUBWORDS]


def instruction_features(
    sentences: Sequence[str], config: DynamicsConfig
) -> Float32[Tensor, "sentences features"]:
    """Words and trigrams of sentences as vectors with a mean square of 1, by signed hashing.

    The cosine of two is about the share of subwords that they have in common (Weinberger et al.
    2009, eq. 1). Without words all are 0, and for cores that read no instruction there are none.
    """
    size = config.instruction_size
    features = torch.zeros(len(sentences), size)
    for row, sentence in zip(features, sentences, strict=True):
        for part in subwords(sentence) if size else ():
            digest = zlib.crc32(part.encode())
            row[digest % size] += 1.0 if digest & _SIGN_BIT else -1.0
    return functional.normalize(features, dim=1) * size**0.5


@dataclass(frozen=True)
class Commands:
    """Hands at the `SAMPLE_OFFSETS` of each latent (`points_m` of `HandMotion`), and at its end."""

    points_m: Float32[Tensor, "batch latents samples 2 points 3"]
    axes: Float32[Tensor, "batch latents 2 6"]
    joints_rad: Float32[Tensor, "batch latents 2 20"]

    def __len__(self) -> int:
        # A tensor while a trace is made.
        return int(self.points_m.shape[1])

    def __getitem__(self, latents: slice) -> "Commands":
        """Select latent steps."""
        return mapped(self, lambda values: values[:, latents])

    def repeated(self, times: int) -> "Commands":
        """The same commands for each of several members, whose entries follow each other."""
        return mapped(self, lambda values: values.repeat(times, *[1] * (values.ndim - 1)))

    @classmethod
    def of(cls, motions: list[HandMotion]) -> "Commands":
        """Commands of a batch: for each entry, the hand motion over the next 4k steps."""
        samples = (
            np.arange(0, len(motions[0]), STEPS_PER_LATENT)[:, None] + np.array(SAMPLE_OFFSETS) - 1
        )
        ends = samples[:, -1]
        return cls(
            torch.from_numpy(np.stack([motion.points_m[samples] for motion in motions])),
            torch.from_numpy(np.stack([motion.axes[ends] for motion in motions])),
            torch.from_numpy(np.stack([motion.joints_rad[ends] for motion in motions])),
        )

    @classmethod
    def holding(cls, motions: list[HandMotion]) -> "Commands":
        """The single latent step, with resting hands, that starts a rollout (one step each)."""
        return cls.of([motion[np.zeros(STEPS_PER_LATENT, dtype=np.int64)] for motion in motions])


@dataclass(frozen=True)
class ObjectPoses:
    """Objects in the world frame.

    `axes` are the directions of the object's z and x axis, shorter than one where they cannot be
    observed (the yaw of a round bowl). `present` is 1 for an object, 0 for unused slots and objects
    out of reach, and a probability in between.
    """

    position_m: Float32[Tensor, "*batch objects 3"]
    axes: Float32[Tensor, "*batch objects 2 3"]
    present: Float32[Tensor, "*batch objects"]

    def __getitem__(self, index: Tensor | int | slice | tuple[slice, int]) -> "ObjectPoses":
        """Index the batch."""
        return mapped(self, lambda values: values[index])

    def slots(self, count: int) -> "ObjectPoses":
        """The first slots."""
        return ObjectPoses(
            self.position_m[..., :count, :], self.axes[..., :count, :, :], self.present[..., :count]
        )


def objects_from_poses(poses: Shaped[np.ndarray, "*batch objects 7"]) -> ObjectPoses:
    """Fill slots with known poses (x y z in metres, qw qx qy qz); further slots stay empty."""
    T = transform_from_pose(np.asarray(poses, dtype=np.float64))
    batch, count = T.shape[:-3], T.shape[-3]
    position = np.zeros((*batch, MAX_OBJECTS, 3), dtype=np.float32)
    axes = np.zeros((*batch, MAX_OBJECTS, 2, 3), dtype=np.float32)
    present = np.zeros((*batch, MAX_OBJECTS), dtype=np.float32)
    near = np.linalg.norm(T[..., :3, 3], axis=-1) <= MAX_DISTANCE_M
    position[..., :count, :] = np.where(near[..., None], T[..., :3, 3], 0.0)
    axes[..., :count, 0, :], axes[..., :count, 1, :] = T[..., :3, 2], T[..., :3, 0]
    present[..., :count] = near
    return ObjectPoses(
        torch.from_numpy(position), torch.from_numpy(axes), torch.from_numpy(present)
    )


def poses_from_objects(objects: ObjectPoses) -> Float64[np.ndarray, "*batch objects 7"]:
    """Rigid poses nearest to predicted ones: z keeps its direction, x is made perpendicular to it.

    Where x is unknown (near zero or along z), any perpendicular direction is taken.
    """
    R = rotations(objects.axes.double()).numpy()
    return pose_from_transform(transform(R, objects.position_m.double().numpy()))


def rotations(axes: Float[Tensor, "*batch 2 3"]) -> Float[Tensor, "*batch 3 3"]:
    """R_world_object nearest to predicted axes, as of `poses_from_objects`."""
    along, across, up = torch.eye(3, dtype=axes.dtype)
    z = _direction(axes[..., 0, :], up)
    x = axes[..., 1, :]
    x = x - z * (x * z).sum(-1, keepdim=True)
    helper = torch.where(z[..., :1].abs() < 0.9, along, across)
    x = _direction(x, functional.normalize(helper - z * (helper * z).sum(-1, keepdim=True), dim=-1))
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def _direction(vectors: Tensor, otherwise: Tensor) -> Tensor:
    length = vectors.norm(dim=-1, keepdim=True)
    return torch.where(length > _SHORTEST, vectors / length.clamp_min(_SHORTEST), otherwise)


def principal_axes(
    second_moment: Float64[Tensor, "dim dim"], num_channels: int
) -> tuple[Float32[Tensor, "dim channels"], Float32[Tensor, " channels"]]:
    """Strongest eigenvectors, of positive largest entries, and the root mean square along each."""
    # Of data that touch few taxels, whose other rows are zero, torch's solver (MKL) can fail.
    values, vectors = map(torch.from_numpy, np.linalg.eigh(second_moment.numpy()))
    basis = vectors[:, -num_channels:].flip(1)
    largest = basis.abs().argmax(dim=0)
    signs = torch.sign(basis[largest, torch.arange(num_channels)])
    rms = values[-num_channels:].flip(0).clamp_min(0).sqrt()
    return (basis * signs).float(), rms.float()


def root_scale(rms: Float32[Tensor, " channels"]) -> Float32[Tensor, " channels"]:
    """Divisors for amplitudes sqrt(rms_c / rms_0), between no and full whitening."""
    strongest = rms[0].clamp_min(1e-6)
    return torch.sqrt((rms / strongest).clamp_min(MIN_RELATIVE_SCALE)) * strongest


def root_pressure(tactile_kpa: Float32[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """Square root of pressures; negative ones count as zero."""
    return tactile_kpa.clamp_min(0.0).sqrt()


class TouchCodec(nn.Module):
    """Frozen encoder and decoder of one hand's taxels, the same for left and right.

    Squared errors of latents are proportional to those of the root of pressure. Decoded pressure is
    bounded by `peak_kpa`, the highest pressure in training.
    """

    basis: Tensor
    scale: Tensor
    peak_kpa: Tensor

    def __init__(self, num_channels: int, num_taxels: int = NUM_TAXELS) -> None:
        super().__init__()
        self.register_buffer("basis", torch.eye(num_taxels, num_channels))
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("peak_kpa", torch.full((), 1e3))

    @torch.no_grad()
    def fit(
        self, tactile_kpa: Float32[Tensor, "n taxels"], *, peak_kpa: float | None = None
    ) -> None:
        """Fit to touch of single hands; `peak_kpa` is by default that of the sample."""
        roots = root_pressure(tactile_kpa).double()
        # Not centred: the mean touch is not a touch that occurs.
        basis, rms = principal_axes(roots.T @ roots / len(roots), self.basis.shape[1])
        self.basis.copy_(basis)
        self.scale.copy_(rms[0].clamp_min(1e-3))
        peak = float(tactile_kpa.max()) if peak_kpa is None else peak_kpa
        self.peak_kpa.fill_(max(peak, FREE_KPA))

    def encode(self, tactile_kpa: Float32[Tensor, "*b taxels"]) -> Float32[Tensor, "*b channels"]:
        """Latents; pressures are clipped to 0 … peak."""
        bounded = torch.minimum(tactile_kpa, self.peak_kpa)
        return (root_pressure(bounded) @ self.basis) / self.scale

    def decode(self, latents: Float32[Tensor, "*b channels"]) -> Float32[Tensor, "*b taxels"]:
        """Pressures in kPa between zero and the peak."""
        roots = ((latents * self.scale) @ self.basis.T).clamp_min(0.0)
        return torch.minimum(roots.square(), self.peak_kpa)
