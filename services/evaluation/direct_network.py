"""Network of the direct judge: object poses from the first image, and commands relative to them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Final

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8
from torch import nn

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, AnchorPoses, poses_from_actions
from dextouch.hands.robot_hand import RobotHand
from dextouch.tactile.layout import SIDES
from services.evaluation.features import NUM_PAD_FEATURES, pad_features
from services.evaluation.object_features import MAX_OBJECTS

NUM_STEPS: Final = 80
# Commands are sampled in the middle and at the end of each of 20 groups of four steps.
GROUP_STEPS: Final = 4
NUM_GROUPS: Final = NUM_STEPS // GROUP_STEPS
# A wrist and five fingertips.
_NUM_POINTS = 6
_NEAR_M = 0.01
_CHANNELS, _KEYPOINTS, _TASK_WIDTH = 24, 24, 16
_CAMERA_SIZE, _PER_OBJECT = 9, 9
_GROUP_FEATURES = 2 * 2 * _NUM_POINTS * (MAX_OBJECTS * 6 + 1) + 2 * 6 + 2 * 20
# Flatter rays are tilted down: they would meet the table far away.
_FLATTEST = -0.15


@dataclass(frozen=True)
class Attempt:
    """First observation of a rollout and all its commands.

    `actions` are those of steps 1 … 80, relative to `anchor`, the poses of step 0.
    """

    task: str
    image: UInt8[np.ndarray, "h w 3"]
    tactile_kpa: Float32[np.ndarray, "2 320"]
    actions: Float64[np.ndarray, "80 67"]
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


class DirectShape(FrozenModel):
    """Shape of the judge's network; stored in the checkpoint. `num_objects` is by task."""

    tasks: tuple[str, ...]
    num_objects: tuple[int, ...]
    hidden: int = 128
    image_size_px: int = 64


@dataclass(frozen=True)
class Views:
    """Head images with camera matrix, camera pose in the world and task index."""

    image: UInt8[torch.Tensor, "n 3 h w"]
    K_head: Float32[torch.Tensor, "n 3 3"]
    T_world_camera: Float32[torch.Tensor, "n 4 4"]
    task: Int64[torch.Tensor, " n"]

    def __getitem__(self, index: torch.Tensor) -> "Views":
        """Select views."""
        return Views(*(getattr(self, part.name)[index] for part in fields(self)))


@dataclass(frozen=True)
class Commands:
    """Hand motion by groups of steps in the world frame (m), and touch at the start."""

    points_m: Float32[torch.Tensor, "n 20 2 2 6 3"]
    axes: Float32[torch.Tensor, "n 20 2 6"]
    joints_rad: Float32[torch.Tensor, "n 20 2 20"]
    touch: Float32[torch.Tensor, "n 24"]

    def __getitem__(self, index: torch.Tensor) -> "Commands":
        """Select attempts."""
        return Commands(*(getattr(self, part.name)[index] for part in fields(self)))


@dataclass(frozen=True)
class Objects:
    """Positions (m) and axes (z and x) of objects in the world; empty slots are arbitrary."""

    position_m: Float32[torch.Tensor, "n 3 3"]
    axes: Float32[torch.Tensor, "n 3 2 3"]


class ObjectFinder(nn.Module):
    """Predicts a pixel and a height for each object of the task from feature points of the image.

    The position is where the pixel's ray reaches the height, so that the camera pose is used
    exactly (feature points: spatial soft-argmax, Levine et al. 2016).
    """

    height_m: torch.Tensor

    def __init__(self, shape: DirectShape) -> None:
        super().__init__()
        self._size_px = shape.image_size_px
        self.register_buffer("height_m", torch.zeros(len(shape.tasks), MAX_OBJECTS))
        self.eye = nn.Sequential(
            nn.Conv2d(3, _CHANNELS, 5, stride=2, padding=2), nn.GELU(),
            nn.Conv2d(_CHANNELS, _CHANNELS, 3, padding=1), nn.GELU(),
            nn.Conv2d(_CHANNELS, _CHANNELS, 3, padding=1), nn.GELU(),
            nn.Conv2d(_CHANNELS, _KEYPOINTS, 1),
        )  # fmt: skip
        self.sharpness = nn.Parameter(torch.ones(_KEYPOINTS))
        self.task = nn.Embedding(len(shape.tasks), _TASK_WIDTH)
        self.head = nn.Sequential(
            nn.Linear(3 * _KEYPOINTS + _TASK_WIDTH + _CAMERA_SIZE, 160), nn.GELU(),
            nn.Linear(160, 160), nn.GELU(), nn.Linear(160, MAX_OBJECTS * _PER_OBJECT),
        )  # fmt: skip

    def forward(self, views: Views) -> Objects:
        """Objects of every view."""
        return self.find(views.image.float() / 255 - 0.5, views)

    def find(
        self, image: Float32[torch.Tensor, "n 3 h w"], views: Views, *, bfloat16: bool = False
    ) -> Objects:
        """Objects of views with images given separately in −0.5 … 0.5; optionally in bfloat16."""
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bfloat16):
            maps = self.eye(image)
        maps = maps.float()
        weight = (maps.flatten(2) * self.sharpness.exp()[:, None]).softmax(-1).view(maps.shape)
        across, down = (torch.linspace(-1, 1, size) for size in (maps.shape[3], maps.shape[2]))
        points = [(weight.sum(2) * across).sum(-1), (weight.sum(3) * down).sum(-1)]
        strength = (weight * maps).sum((2, 3)).tanh()
        T = views.T_world_camera
        camera = torch.cat([T[:, :3, 3], T[:, :3, 2], T[:, :3, 0]], dim=1)
        outputs = self.head(torch.cat([*points, strength, self.task(views.task), camera], dim=1))
        outputs = outputs.unflatten(1, (MAX_OBJECTS, _PER_OBJECT))
        height_m = self.height_m[views.task] + 0.05 * outputs[..., 2]
        pixel = (outputs[..., :2] + 1) * self._size_px / 2
        return Objects(_at_height(pixel, height_m, views), outputs[..., 3:].unflatten(-1, (2, 3)))


def _at_height(
    pixel: Float32[torch.Tensor, "n 3 2"], height_m: Float32[torch.Tensor, "n 3"], views: Views
) -> Float32[torch.Tensor, "n 3 3"]:
    """Points at which the rays of pixels reach heights above the table."""
    K, T = views.K_head, views.T_world_camera
    focal = torch.diagonal(K, dim1=1, dim2=2)[:, None, :2]
    seen = torch.cat([(pixel - K[:, None, :2, 2]) / focal, torch.ones_like(pixel[..., :1])], dim=-1)
    ray = seen @ T[:, :3, :3].transpose(1, 2)
    eye_m = T[:, None, :3, 3]
    reach = (height_m - eye_m[..., 2]) / ray[..., 2].clamp_max(_FLATTEST)
    return torch.cat([eye_m[..., :2] + reach[..., None] * ray[..., :2], height_m[..., None]], -1)


class DirectNetwork(nn.Module):
    """Gated recurrent network on commands relative to the objects found."""

    num_objects: torch.Tensor

    def __init__(self, shape: DirectShape) -> None:
        super().__init__()
        self.finder = ObjectFinder(shape)
        self.register_buffer("num_objects", torch.tensor(shape.num_objects))
        self.task = nn.Embedding(len(shape.tasks), _TASK_WIDTH)
        self.entry = nn.Sequential(
            nn.Linear(_GROUP_FEATURES + _TASK_WIDTH, shape.hidden), nn.GELU(), nn.Dropout(0.1)
        )
        self.recurrent = nn.GRU(shape.hidden, shape.hidden, batch_first=True)
        self.head = nn.Sequential(
            nn.Dropout(0.2),
            nn.Linear(2 * shape.hidden + NUM_PAD_FEATURES, 64), nn.GELU(), nn.Linear(64, 1),
        )  # fmt: skip

    def forward(self, views: Views, commands: Commands) -> Float32[torch.Tensor, " n"]:
        """Log odds of success."""
        return self.judge(self.finder(views), commands, views.task)

    def judge(
        self, objects: Objects, commands: Commands, task: Int64[torch.Tensor, " n"]
    ) -> Float32[torch.Tensor, " n"]:
        """Log odds of success for known objects."""
        used = torch.arange(MAX_OBJECTS) < self.num_objects[task][:, None]
        features = command_features(commands, objects, used)
        known = self.task(task)
        steps = known[:, None].expand(-1, features.shape[1], -1)
        states, _ = self.recurrent(self.entry(torch.cat([features, steps], dim=-1)))
        outputs = self.head(torch.cat([states[:, -1], states.amax(dim=1), commands.touch], dim=-1))
        return torch.as_tensor(outputs[:, 0])


def command_features(
    commands: Commands, objects: Objects, used: torch.Tensor
) -> Float32[torch.Tensor, "n 20 features"]:
    """Hand points relative to each object, in world axes and the object's axes, and hand poses.

    Distances are compressed, asinh(d / 1 cm) / 2: success is decided by millimetres.
    """
    offset = commands.points_m[..., None, :] - objects.position_m[:, None, None, None, None]
    z, x = objects.axes[:, :, 0], objects.axes[:, :, 1]
    frame = torch.stack([z, x, torch.linalg.cross(z, x)], dim=-2)
    own = torch.einsum("nglhpoi,noai->nglhpoa", offset, frame)
    beside = torch.asinh(torch.cat([offset, own], dim=-1) / _NEAR_M) / 2
    beside = beside * used[:, None, None, None, None, :, None]
    heights = torch.asinh(commands.points_m[..., 2] / _NEAR_M) / 2
    parts = [beside, heights, commands.axes, commands.joints_rad]
    return torch.cat([part.flatten(2) for part in parts], dim=-1)


def attempt_tensors(attempts: Sequence[Attempt], shape: DirectShape) -> tuple[Views, Commands]:
    """Network tensors of attempts, for training and prediction alike.

    Raises:
        UnknownNameError: a task that the judge was not trained for.
        InvalidInputError: an image of another size.
    """
    for one in attempts:
        if one.task not in shape.tasks:
            raise UnknownNameError("task of the direct judge", one.task, list(shape.tasks))
        size = (shape.image_size_px, shape.image_size_px, 3)
        if one.image.shape != size:
            raise InvalidInputError(
                f"direct judge: got an image {one.image.shape}, expected {size}"
            )
    views = views_of(
        np.stack([one.image for one in attempts]),
        np.stack([one.K_head for one in attempts]),
        np.stack([one.anchor.T_world_camera_head for one in attempts]),
        [shape.tasks.index(one.task) for one in attempts],
    )
    motions = [_hand_motion(one) for one in attempts]
    points, axes, joints = (torch.from_numpy(np.stack(part)) for part in zip(*motions, strict=True))
    touch = pad_features(np.stack([one.tactile_kpa for one in attempts]))
    felt = torch.from_numpy(touch.reshape(len(attempts), -1))
    return views, Commands(points, axes, joints, felt)


def views_of(
    images: UInt8[np.ndarray, "n h w 3"],
    K_head: np.ndarray,
    Ts_world_camera: np.ndarray,
    task: Sequence[int],
) -> Views:
    """Views as tensors."""
    return Views(
        torch.from_numpy(images).permute(0, 3, 1, 2).contiguous(),
        torch.from_numpy(K_head.astype(np.float32)),
        torch.from_numpy(Ts_world_camera.astype(np.float32)),
        torch.tensor(task),
    )


@cache
def _hand(side: str) -> RobotHand:
    return RobotHand(side)


def _hand_motion(attempt: Attempt) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, wrist axes and joint angles of an attempt at the sampled steps."""
    poses = poses_from_actions(attempt.actions, attempt.anchor)
    Ts = np.stack([poses.Ts_world_wrist_left, poses.Ts_world_wrist_right], axis=1)
    joints = np.stack([attempt.actions[:, JOINTS_LEFT], attempt.actions[:, JOINTS_RIGHT]], axis=1)
    ends = np.arange(1, NUM_GROUPS + 1) * GROUP_STEPS - 1
    looks = np.stack([ends - GROUP_STEPS // 2, ends], axis=1)
    tips = np.stack(
        [_hand(side).fingertips_m(joints[looks.ravel(), i]) for i, side in enumerate(SIDES)],
        axis=1,
    )
    R, t = Ts[looks.ravel(), :, :3, :3], Ts[looks.ravel(), :, :3, 3]
    local = np.concatenate([np.zeros_like(tips[:, :, :1]), tips], axis=2)
    points = local @ np.swapaxes(R, -1, -2) + t[:, :, None]
    R_end = Ts[ends, :, :3, :3]
    return (
        points.reshape(NUM_GROUPS, 2, 2, _NUM_POINTS, 3).astype(np.float32),
        np.concatenate([R_end[..., 0], R_end[..., 1]], axis=-1).astype(np.float32),
        joints[ends].astype(np.float32),
    )
