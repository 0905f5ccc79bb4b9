"""Start reader: object poses of a task from one head image, touch and hand poses.

A convolutional network with feature points (spatial soft-argmax, Levine et al. 2016) predicts a
pixel and a height for every object; the position is where the pixel's ray reaches that height. A
second network corrects it from a crop about the pixel.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int64, UInt8
from torch import Tensor, nn
from torch.nn import functional

from dextouch.schemas import MAX_OBJECTS
from services.world_model.dynamics.core import NUM_PADS
from services.world_model.dynamics.features import (
    MAX_DISTANCE_M,
    NUM_POINTS,
    DynamicsConfig,
    ObjectPoses,
    compressed,
    rotations,
)

TASK_WIDTH = 16
_POINT_SIZE = 2 * NUM_POINTS * 3
_CAMERA_SIZE = 7
# Outputs of an object: pixel (2), height, axes (6), presence, uncertainty, size (2).
_OUTPUTS = 13
# Corrections of a pixel are this much smaller than first guesses.
_FINE = 0.1
# Width and height of an image's crop about an object.
_CROP_PX = 24
_LOG_SIZE = 0.5
LEAST_SD_M = 0.001
# Uncertainty of an output of zero.
_USUAL_SD_M = 0.005
# Added to the contrast of a channel, so that a blank image stays finite.
_LEAST_CONTRAST = 0.02
# Rays flatter than this do not meet the table within reach.
_FLATTEST = -0.15


@dataclass(frozen=True)
class FirstStep:
    """One observed step; everything in the world frame, metres and kPa."""

    image: UInt8[Tensor, "batch px px 3"]
    K_head: Float32[Tensor, "batch 3 3"]
    T_world_camera: Float32[Tensor, "batch 4 4"]
    points_m: Float32[Tensor, "batch 2 12 3"]
    pads_kpa: Float32[Tensor, "batch 12"]
    task: Int64[Tensor, " batch"]


@dataclass(frozen=True)
class Reading:
    """Objects of one step; `sd_m` on each axis of the table, factors of usual width and height."""

    objects: ObjectPoses
    sd_m: Float32[Tensor, "batch objects"]
    size: Float32[Tensor, "batch objects 2"]


class StartReader(nn.Module):
    """Predicts objects from one observed step, whatever the exposure and colour of the light."""

    height_mean: Tensor

    def __init__(self, config: DynamicsConfig) -> None:
        super().__init__()
        self.config = config
        channels, points = config.reader_channels, config.reader_keypoints
        self.register_buffer("height_mean", torch.zeros(len(config.tasks), MAX_OBJECTS))
        self.eye = nn.Sequential(
            nn.Conv2d(3, channels, 5, stride=2, padding=2), nn.GELU(),
            nn.Conv2d(channels, channels, 3, padding=1), nn.GELU(),
            nn.Conv2d(channels, channels, 3, padding=1), nn.GELU(),
            nn.Conv2d(channels, points, 1),
        )  # fmt: skip
        self.sharpness = nn.Parameter(torch.ones(points))
        self.task = nn.Embedding(len(config.tasks), TASK_WIDTH)
        known = 3 * points + TASK_WIDTH + _POINT_SIZE + NUM_PADS + _CAMERA_SIZE
        self.head = nn.Sequential(
            nn.Linear(known, 192), nn.GELU(), nn.Linear(192, 192), nn.GELU(),
            nn.Linear(192, MAX_OBJECTS * _OUTPUTS),
        )  # fmt: skip
        self.lens = nn.Sequential(
            nn.Conv2d(3, channels, 5, stride=2, padding=2), nn.GELU(),
            nn.Conv2d(channels, 48, 3, padding=1), nn.GELU(),
            nn.Conv2d(48, 64, 3, stride=2, padding=1), nn.GELU(),
            nn.Flatten(), nn.Linear(64 * (_CROP_PX // 4) ** 2, 128), nn.GELU(),
        )  # fmt: skip
        about = TASK_WIDTH + MAX_OBJECTS + _POINT_SIZE + NUM_PADS + _CAMERA_SIZE + _OUTPUTS
        last = nn.Linear(128, _OUTPUTS)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.correction = nn.Sequential(
            nn.Linear(128 + about, 192), nn.GELU(), nn.Linear(192, 128), nn.GELU(), last
        )

    def forward(self, first: FirstStep) -> Reading:
        """Objects of every entry; `present` holds probabilities, 0 in slots unused by the task."""
        return self.read(first.image.permute(0, 3, 1, 2).float() / 255, first)[-1]

    def read(
        self, image: Float32[Tensor, "batch 3 px px"], first: FirstStep, *, bfloat16: bool = False
    ) -> tuple[Reading, Reading]:
        """First and corrected reading of an image in 0 … 1; optionally in bfloat16."""
        contrast = image.std((2, 3), keepdim=True) + _LEAST_CONTRAST
        plain = (image - image.mean((2, 3), keepdim=True)) / contrast
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bfloat16):
            maps = self.eye(plain)
        outputs = self.head(self._known(maps.float(), first))
        outputs = outputs.view(-1, MAX_OBJECTS, _OUTPUTS)
        guess = self._reading(outputs, first)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bfloat16):
            seen: Tensor = self.lens(self._crops(plain, outputs[..., :2].detach()).flatten(0, 1))
        crops = seen.float().view(-1, MAX_OBJECTS, seen.shape[-1])
        about = torch.cat([crops, self._about(outputs, guess, first)], dim=-1)
        fine = torch.ones(_OUTPUTS)
        fine[:2] = _FINE
        return guess, self._reading(outputs + fine * self.correction(about), first)

    def _crops(
        self, image: Float32[Tensor, "batch 3 px px"], places: Float32[Tensor, "batch objects 2"]
    ) -> Float32[Tensor, "batch objects 3 rows columns"]:
        """The image about places given in −1 … 1, one pixel wide each."""
        px = self.config.image_px
        across = (torch.arange(_CROP_PX) - 0.5 * (_CROP_PX - 1)) * (2 / px)
        offset = torch.stack(torch.meshgrid(across, across, indexing="xy"), dim=-1)
        grid = places.clamp(-1.0, 1.0)[:, :, None, None] + offset
        crops = functional.grid_sample(
            image, grid.flatten(1, 2), padding_mode="border", align_corners=False
        )
        return crops.view(-1, 3, MAX_OBJECTS, _CROP_PX, _CROP_PX).transpose(1, 2)

    def _about(
        self, outputs: Tensor, guess: Reading, first: FirstStep
    ) -> Float32[Tensor, "batch objects size"]:
        """What is known of each object besides its crop: hands in its frame, touch, first guess."""
        position_m = guess.objects.position_m.detach()
        R = rotations(guess.objects.axes.detach())
        offset = first.points_m.flatten(1, 2)[:, None] - position_m[:, :, None]
        points = compressed(torch.einsum("bopi,boij->bopj", offset, R)).flatten(2)
        slot = torch.eye(MAX_OBJECTS).expand(len(outputs), -1, -1)
        shared = torch.cat(
            [self.task(first.task), compressed(first.pads_kpa * 1e-2), _camera(first)], dim=1
        )
        each = shared[:, None].expand(-1, MAX_OBJECTS, -1)
        return torch.cat([each, slot, points, outputs.detach()], dim=-1)

    def _reading(self, outputs: Float32[Tensor, "batch objects 13"], first: FirstStep) -> Reading:
        pixel = (outputs[..., :2] * 0.5 + 0.5) * self.config.image_px
        height_m = self.height_mean[first.task] + 0.05 * outputs[..., 2]
        counts = torch.tensor(self.config.num_objects)[first.task]
        used = torch.arange(MAX_OBJECTS) < counts[:, None]
        present = outputs[..., 9].sigmoid() * used
        position = ray_at_height(pixel, height_m, first.K_head, first.T_world_camera)
        axes = outputs[..., 3:9].reshape(*outputs.shape[:2], 2, 3)
        objects = ObjectPoses(position, axes, present)
        sd_m = (_USUAL_SD_M * outputs[..., 10].clamp(-4.0, 4.0).exp()).clamp_min(LEAST_SD_M)
        return Reading(objects, sd_m, (_LOG_SIZE * outputs[..., 11:13].tanh()).exp())

    def _known(
        self, maps: Float32[Tensor, "batch points rows columns"], first: FirstStep
    ) -> Float32[Tensor, "batch known"]:
        weight = (maps.flatten(2) * self.sharpness.exp()[:, None]).softmax(-1).view(maps.shape)
        places = torch.linspace(-1, 1, maps.shape[-1])
        columns = (weight.sum(2) * places).sum(-1)
        rows = (weight.sum(3) * places).sum(-1)
        strength = (weight * maps).sum((2, 3))
        points = compressed(first.points_m).flatten(1)
        seen = (3 * columns, 3 * rows, strength.tanh(), self.task(first.task), points)
        return torch.cat([*seen, compressed(first.pads_kpa * 1e-2), _camera(first)], dim=1)


def _camera(first: FirstStep) -> Float32[Tensor, "batch 7"]:
    T = first.T_world_camera
    return 5.0 * torch.cat([T[:, :3, 3], T[:, :2, 2], T[:, :2, 0]], dim=1)


def ray_at_height(
    pixel: Float32[Tensor, "batch objects 2"],
    height_m: Float32[Tensor, "batch objects"],
    K_head: Float32[Tensor, "batch 3 3"],
    T_world_camera: Float32[Tensor, "batch 4 4"],
) -> Float32[Tensor, "batch objects 3"]:
    """World point (m) where a pixel's ray, tilted if it is flat, reaches a height."""
    focal = torch.stack([K_head[:, 0, 0], K_head[:, 1, 1]], dim=-1)[:, None]
    centre = K_head[:, None, :2, 2]
    flat = (pixel - centre) / focal
    ray = torch.cat([flat, torch.ones_like(flat[..., :1])], dim=-1)
    ray = ray @ T_world_camera[:, :3, :3].transpose(1, 2)
    eye_m = T_world_camera[:, None, :3, 3]
    reach = (height_m - eye_m[..., 2]) / ray[..., 2].clamp_max(_FLATTEST)
    point = eye_m[..., :2] + reach[..., None] * ray[..., :2]
    return torch.cat([point, height_m[..., None]], dim=-1).clamp(-MAX_DISTANCE_M, MAX_DISTANCE_M)
