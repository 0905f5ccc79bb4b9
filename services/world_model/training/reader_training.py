"""Training of start readers on single steps, with first images as other cameras take them."""

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor, nn
from torch.nn import functional

from dextouch.images import decode_jpeg, encode_jpeg
from dextouch.schemas import MAX_OBJECTS
from services.networks.optimizer import (
    Budget,
    OptimizerLoop,
    OptimizerOptions,
    half_cosine,
    update_average,
)
from services.world_model.dynamics.features import DynamicsConfig, ObjectPoses
from services.world_model.dynamics.start_reader import FirstStep, Reading, StartReader
from services.world_model.dynamics.tensor_trees import combined
from services.world_model.rendering.renderer import uses_bfloat16
from services.world_model.settings import CoreSettings, ReaderSettings
from services.world_model.training.scene_table import SceneTable

# Metres that count as one in the errors of positions.
UNIT_M = 0.05
_BATCH_OF_READING = 128
_WEIGHT_DECAY = 1e-3
_SD_WEIGHT = 0.02
_SIZE_WEIGHT, _UNIT_LOG = 0.3, 0.1
# Of the first guess, which the correction starts from.
_GUESS_WEIGHT = 0.5
# Standard deviations of the logarithm of gain, of each channel's gain, of contrast and of gamma.
_GAIN, _TINT, _CONTRAST, _GAMMA = 0.15, 0.08, 0.15, 0.15
_MOST_NOISE = 0.03
# Shifts of the image, of which the intrinsics know all but a remainder (standard deviation).
_MOST_SHIFT_PX, _UNKNOWN_SHIFT_PX = 1.5, 0.15
_JPEG_SHARE, _JPEG_QUALITY = 0.2, (25, 95)
_PLAIN_SHARE = 0.15
_WARMUP_STEPS = 100
OnStep = Callable[[int, float], None]
Network = TypeVar("Network", bound=nn.Module)


def train_reader(
    table: SceneTable,
    config: DynamicsConfig,
    settings: ReaderSettings,
    *,
    seed: int,
    on_step: OnStep | None = None,
    initial: StartReader | None = None,
) -> StartReader:
    """Train a reader, or `initial`, on single steps of labelled episodes, first and later ones."""
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        reader = initial or StartReader(config)
    _fit_heights(reader, table, config)
    later = [step for step in table.image_steps if step % 4 == 0 and step > 0]
    known = torch.nonzero(table.labelled)[:, 0]
    # Steps at which the pose of an object is known; all of tasks without objects.
    counts = torch.tensor(config.num_objects)[table.task]
    is_slot = torch.arange(MAX_OBJECTS) < counts[:, None]
    is_known = (table.objects_known & is_slot[:, None]).any(-1) | (counts == 0)[:, None]
    # Later steps of each episode, in their order; of further ones nothing is known, they have no
    # image or lie behind its end.
    places = [table.image_steps.index(step) for step in later]
    reached = (torch.tensor(later) < table.length[:, None]) & table.shown[:, places]
    reached &= is_known[:, later]
    counts = reached.sum(1)
    order = torch.argsort(~reached, dim=1, stable=True)
    bfloat16 = uses_bfloat16(setting=settings.bfloat16)

    def loss() -> Tensor:
        rows = table.drawn(known, settings.batch, generator)
        drawn = torch.randint(len(later), rows.shape, generator=generator)
        amid = torch.tensor(later)[order[rows, drawn % counts[rows].clamp_min(1)]]
        is_first = torch.rand(rows.shape, generator=generator) < settings.first_fraction
        is_first &= is_known[rows, 0]
        steps = torch.where(is_first | (counts[rows] == 0), 0, amid)
        first, true = table.first_steps(rows, steps), table.objects_at(rows, steps)
        image, first = as_another_camera(first, generator)
        guess, reading = reader.read(image, first, bfloat16=bfloat16)
        is_posed = table.objects_known[rows, steps]
        count = torch.tensor(config.num_objects)[first.task]
        used = (torch.arange(MAX_OBJECTS) < count[:, None]) & is_posed
        about = (true, table.size[rows], used, true.present * is_posed)
        return _error(reading, *about) + _GUESS_WEIGHT * _error(guess, *about)

    return train_averaged(reader, loss, settings, weight_decay=_WEIGHT_DECAY, on_step=on_step)


def _fit_heights(reader: StartReader, table: SceneTable, config: DynamicsConfig) -> None:
    """Fit resting heights: medians over the first steps of each task's episodes."""
    for task, count in enumerate(config.num_objects):
        for slot in range(count):
            first = table.objects.position_m[:, 0, slot, 2]
            there = (table.task == task) & (table.objects.present[:, 0, slot] > 0) & table.labelled
            there &= table.objects_known[:, 0, slot]
            if there.any():
                reader.height_mean[task, slot] = first[there].median()


def _error(
    reading: Reading,
    true: ObjectPoses,
    size: Tensor,
    used: Bool[Tensor, "batch objects"],
    there: Float32[Tensor, "batch objects"],
) -> Float32[Tensor, ""]:
    """Errors of objects that are `there`, and of the presence of the slots that are `used`."""
    predicted = reading.objects
    position = functional.smooth_l1_loss(
        predicted.position_m / UNIT_M, true.position_m / UNIT_M, beta=0.1, reduction="none"
    ).sum(-1)
    axes = (predicted.axes - true.axes).square().sum((-1, -2))
    presence = functional.binary_cross_entropy(
        predicted.present.clamp(1e-4, 1 - 1e-4), true.present, reduction="none"
    )
    # Of a Gaussian on both axes of the table; the position is not trained by it.
    lateral_m = (predicted.position_m - true.position_m)[..., :2].detach().square().sum(-1)
    surprise = 2 * reading.sd_m.log() + lateral_m / (2 * reading.sd_m.square())
    # Squared: of an unclear size the mean is wanted, not the usual size, which most objects have.
    grown = ((reading.size.log() - size.log()) / _UNIT_LOG).square().sum(-1)
    each = position + axes + _SD_WEIGHT * surprise + _SIZE_WEIGHT * grown
    return (each * there).sum() / there.sum().clamp_min(1.0) + 0.3 * (
        presence * used
    ).sum() / used.sum().clamp_min(1)


@torch.no_grad()
def read_step(reader: StartReader, table: SceneTable, step: int) -> Reading:
    """What the reader makes of one step of every episode."""
    parts: list[Reading] = [
        reader(table.first_steps(rows, torch.full_like(rows, step)))
        for rows in torch.split(torch.arange(len(table)), _BATCH_OF_READING)
    ]
    return combined(parts, torch.cat)


def reader_errors(reader: StartReader, table: SceneTable) -> dict[str, float]:
    """Median and 90 % quantile of errors (mm) over the table at first steps, by task."""
    predicted, errors = read_step(reader, table, 0).objects, dict[str, float]()
    true = table.objects_at(torch.arange(len(table)), 0)
    for index, task in enumerate(reader.config.tasks):
        known = table.objects_known[:, 0] & (table.task == index)[:, None]
        there = (true.present > 0) & known
        if there.any():
            off_mm = 1e3 * (predicted.position_m - true.position_m)[there]
            lateral = off_mm[:, :2].norm(dim=-1)
            errors[f"start_lateral_mm_{task}"] = float(lateral.median())
            errors[f"start_lateral_90_mm_{task}"] = float(lateral.quantile(0.9))
    return errors


def as_another_camera(
    first: FirstStep, generator: torch.Generator
) -> tuple[Float32[Tensor, "batch 3 px px"], FirstStep]:
    """Images (0 … 1) as other cameras might take them, but for a share, and their intrinsics."""
    count, px = len(first.image), first.image.shape[1]

    def normal(*shape: int) -> Tensor:
        return torch.randn((count, *shape), generator=generator)

    def uniform(*shape: int) -> Tensor:
        return torch.rand((count, *shape), generator=generator)

    plain = uniform() < _PLAIN_SHARE
    original = first.image.permute(0, 3, 1, 2).float() / 255
    shift_px = (2 * uniform(2) - 1) * _MOST_SHIFT_PX
    image = _shifted(original, shift_px)
    image = image * (_GAIN * normal(1, 1, 1) + _TINT * normal(3, 1, 1)).exp()
    mean = image.mean((1, 2, 3), keepdim=True)
    image = mean + (image - mean) * (_CONTRAST * normal(1, 1, 1)).exp()
    image = image.clamp(0.0, 1.0).pow((_GAMMA * normal(1, 1, 1)).exp())
    image = torch.lerp(image, _blurred(image), (2 * uniform(1, 1, 1) - 1).clamp_min(0.0))
    image = image + normal(3, px, px) * _MOST_NOISE * uniform(1, 1, 1).square()
    image = _compressed(image.clamp(0.0, 1.0), uniform(2).numpy())
    K = first.K_head.clone()
    K[:, :2, 2] += torch.where(plain[:, None], 0.0, shift_px + _UNKNOWN_SHIFT_PX * normal(2))
    return torch.where(plain[:, None, None, None], original, image), replace(first, K_head=K)


def _shifted(
    image: Float32[Tensor, "batch 3 px px"], shift_px: Float32[Tensor, "batch 2"]
) -> Float32[Tensor, "batch 3 px px"]:
    """Content moved right and down, with repeated borders."""
    count, px = len(image), image.shape[-1]
    affine = torch.eye(2, 3).repeat(count, 1, 1)
    affine[:, :, 2] = -2 * shift_px / px
    grid = functional.affine_grid(affine, list(image.shape), align_corners=False)
    return functional.grid_sample(image, grid, padding_mode="border", align_corners=False)


def _blurred(image: Float32[Tensor, "batch 3 px px"]) -> Float32[Tensor, "batch 3 px px"]:
    weights = torch.tensor([0.25, 0.5, 0.25])
    kernel = (weights[:, None] * weights).expand(3, 1, 3, 3)
    return functional.conv2d(
        functional.pad(image, (1, 1, 1, 1), mode="replicate"), kernel, groups=3
    )


def _compressed(image: Float32[Tensor, "batch 3 px px"], draw: np.ndarray) -> Tensor:
    low, high = _JPEG_QUALITY
    for index in np.flatnonzero(draw[:, 0] < _JPEG_SHARE):
        pixels = (image[index].permute(1, 2, 0) * 255).round().byte().numpy()
        quality = int(low + (high - low) * draw[index, 1])
        decoded = decode_jpeg(encode_jpeg(pixels, quality=quality)).copy()
        image[index] = torch.from_numpy(decoded).permute(2, 0, 1).float() / 255
    return image


def train_averaged(
    network: Network,
    loss: Callable[[], Tensor],
    settings: ReaderSettings | CoreSettings,
    *,
    weight_decay: float,
    on_step: OnStep | None = None,
) -> Network:
    """Train a network in place on fresh batches of `loss`; returns its moving average."""
    options = OptimizerOptions(
        settings.learning_rate,
        weight_decay,
        warmup_steps=_WARMUP_STEPS,
        schedule=lambda share: 0.01 + 0.99 * half_cosine(share),
    )
    budget = Budget(max_steps=settings.num_steps)
    averaged = copy.deepcopy(network)
    for value in OptimizerLoop(network, options, budget).run(loss):
        # Begins with a longer memory than that of a first update.
        weights = averaged.parameters(), network.parameters()
        update_average(*weights, decay=settings.ema_decay, num_updates=budget.step)
        if on_step is not None:
            on_step(budget.step, value)
    return averaged.eval()
