"""Training of a recurrent core on whole episodes: object motion and touch."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, Int64
from torch import Tensor
from torch.nn import functional

from dextouch.tactile import CONTACT_THRESHOLD_KPA
from services.world_model.dynamics.configuration import STEPS_PER_LATENT, DynamicsConfig
from services.world_model.dynamics.core import RecurrentCore, SceneFuture, SceneStart
from services.world_model.dynamics.features import command_features
from services.world_model.dynamics.model import Commands
from services.world_model.dynamics.objects import ObjectPoses
from services.world_model.dynamics.touch_codec import TouchCodec
from services.world_model.rendering.precision import uses_bfloat16
from services.world_model.settings import CoreSettings
from services.world_model.training.averaging import OnStep, train_averaged
from services.world_model.training.scene_table import SceneTable

_UNIT_M = 0.05
_FIT_EPISODES = 400
# Added to the deviation of features, some of which hardly vary within a task.
_LEAST_DEVIATION = 0.05
# Factor by which hands are held still more often at later starts, where fewer scenes allow it.
_LATER_HELD = 2.5
# Objects that moved less than this in the previous latent step count as settled.
_SETTLED_M = 1e-3
# Cores are trained from the first step and from every so many steps after it.
_START_STRIDE = 8
_TAXEL_SHARE = 4


@dataclass(frozen=True)
class CoreData:
    """Training data of cores: episodes, touch latents and the readers' outputs.

    `readings` are a reader's objects by start step, for the episodes that the reader was trained
    on. Since its errors are smaller there than on new scenes, the core is trained equally often on
    ground-truth poses with noise of `pose_noise_m`.
    """

    table: SceneTable
    touch: Float16[Tensor, "episodes steps 2 channels"]
    readings: Mapping[int, ObjectPoses]


@dataclass(frozen=True)
class _Batch:
    rows: Int64[Tensor, " batch"]
    start_step: int
    start: SceneStart
    commands: Commands
    is_held: Bool[Tensor, " batch"]


def train_core(
    data: CoreData,
    config: DynamicsConfig,
    settings: CoreSettings,
    *,
    seed: int,
    on_step: OnStep | None = None,
) -> RecurrentCore:
    """Train a core to predict scenes from any start step to the end.

    Args:
        data: training episodes.
        config: of the dynamics model.
        settings: number of steps, loss weights and so on.
        seed: seed of weights and sampling.
        on_step: called with the step and its loss.
    """
    generator, rng = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        core = RecurrentCore(config)
        fit_features(core, data.table)

        def loss() -> Tensor:
            return core_loss(core, data, _draw(data, settings, generator, rng), settings)

        return train_averaged(
            core, loss, settings, weight_decay=settings.weight_decay, on_step=on_step
        )


@torch.no_grad()
def fit_features(core: RecurrentCore, table: SceneTable) -> None:
    """Fit mean and deviation of command features to the training episodes of each task."""
    for task in range(len(core.config.tasks)):
        known = torch.nonzero(table.labelled & (table.task == task))[:, 0]
        rows = known[:: max(1, len(known) // _FIT_EPISODES)]
        commands = table.commands(rows, 0, torch.zeros(len(rows), dtype=torch.bool))
        objects = table.objects_at(rows, 0)
        features = command_features(
            commands.points_m, commands.axes, commands.joints_rad, objects
        ).flatten(0, 1)
        core.feature_mean[task] = features.mean(0)
        core.feature_std[task] = features.std(0) + _LEAST_DEVIATION


def start_steps(table: SceneTable) -> list[int]:
    """Steps with an image from which cores are trained, up to the last possible latent step."""
    last = table.num_steps - 1 - STEPS_PER_LATENT
    wanted = {*range(0, last, _START_STRIDE), last}
    return [step for step in table.image_steps if step in wanted]


def _later_start(later: list[int], num_steps: int, rng: np.random.Generator) -> int:
    """Random start, with a probability proportional to the root of the remaining length.

    Starts near the end teach little about persistence, but rollouts begin there, too.
    """
    weight = np.sqrt([num_steps - 1 - step for step in later])
    return int(rng.choice(later, p=weight / weight.sum()))


def _draw(
    data: CoreData, settings: CoreSettings, generator: torch.Generator, rng: np.random.Generator
) -> _Batch:
    table = data.table
    is_first = rng.random() < settings.first_fraction
    later = [step for step in data.readings if step > 0]
    start_step = 0 if is_first or not later else _later_start(later, table.num_steps, rng)
    rows = torch.randint(len(table), (settings.batch,), generator=generator)

    def chance(fraction: float) -> Bool[Tensor, " batch"]:
        return torch.rand(len(rows), generator=generator) < fraction

    measured = chance(settings.measured_fraction) | ~table.commanded[rows]
    commands = table.commands(rows, start_step, measured)
    held = chance(settings.held_fraction * (1 if start_step == 0 else _LATER_HELD))
    held &= _is_settled(table, rows, start_step) & table.labelled[rows]
    objects = _start_objects(data, rows, start_step, settings, generator)
    return _Batch(
        rows=rows,
        start_step=start_step,
        start=SceneStart(
            objects,
            data.touch[rows, start_step].float(),
            table.pads_kpa[rows, start_step],
            table.task[rows],
            (~measured).float(),
        ),
        commands=_held_still(commands, held),
        is_held=held,
    )


def _is_settled(table: SceneTable, rows: Tensor, start_step: int) -> Bool[Tensor, " batch"]:
    """Entries without contact and object motion: holding still, nothing would change."""
    free = ~table.in_contact[rows, start_step].any(-1)
    before = max(0, start_step - STEPS_PER_LATENT)
    position_m = table.objects.position_m
    moved_m = (position_m[rows, start_step] - position_m[rows, before]).norm(dim=-1).amax(-1)
    return free & (moved_m < _SETTLED_M)


def _start_objects(
    data: CoreData,
    rows: Tensor,
    start_step: int,
    settings: CoreSettings,
    generator: torch.Generator,
) -> ObjectPoses:
    """A reader's objects or, half of the time and where known, true objects with noise."""
    true, read = data.table.objects_at(rows, start_step), data.readings[start_step][rows]
    size = settings.pose_noise_m * 2 * torch.rand((len(rows), 1, 1), generator=generator)
    shift = torch.randn(true.position_m.shape, generator=generator) * size
    shift[..., 2] *= 0.3
    turn = torch.randn(true.axes.shape, generator=generator) * size[..., None] * 5.0
    use_read = torch.rand((len(rows), 1), generator=generator) < 0.5
    use_read |= ~data.table.labelled[rows, None]
    return ObjectPoses(
        torch.where(use_read[..., None], read.position_m, true.position_m + shift),
        torch.where(use_read[..., None, None], read.axes, true.axes + turn),
        torch.where(use_read, read.present, true.present),
    )


def _held_still(commands: Commands, held: Bool[Tensor, " batch"]) -> Commands:
    def still(values: Tensor) -> Tensor:
        chosen = held.view(-1, *[1] * (values.ndim - 1))
        return torch.where(chosen, values[:, :1].expand_as(values), values)

    return Commands(still(commands.points_m), still(commands.axes), still(commands.joints_rad))


def core_loss(
    core: RecurrentCore, data: CoreData, batch: _Batch, settings: CoreSettings
) -> Float32[Tensor, ""]:
    """Weighted sum of the errors in objects, touch, contact and final success.

    Where hands are held still without contact, the targets are no motion and no change of touch.
    """
    commands, start = batch.commands, batch.start
    features = command_features(
        commands.points_m, commands.axes, commands.joints_rad, start.objects
    )
    with torch.autocast(
        "cpu", dtype=torch.bfloat16, enabled=uses_bfloat16(setting=settings.bfloat16)
    ):
        future, _ = core(features, start, core.first_state(start))
    future = _in_float32(future)
    table, rows = data.table, batch.rows
    true = _stand(table.objects_of_latents(rows, batch.start_step), batch.is_held)
    steps = table.steps_after(batch.start_step)
    moves = ~batch.is_held
    touch = data.touch[rows][:, steps].float()
    at_start = start.touch[:, None, None].expand_as(touch)
    touch = torch.where(moves.view(-1, 1, 1, 1, 1), touch, at_start)
    contact = table.in_contact[rows][:, steps] & moves.view(-1, 1, 1, 1)
    # Part of the batch suffices: each of its rows has thousands of taxels.
    few = slice(0, -(-len(rows) // _TAXEL_SHARE))
    felt = table.tactile_kpa[rows[few]][:, steps] >= CONTACT_THRESHOLD_KPA
    felt &= moves[few].view(-1, 1, 1, 1, 1)
    success = table.success[rows] * moves
    weights = settings.weights
    return (
        weights.objects
        * _object_error(future.objects, true, start.objects.present * table.labelled[rows, None])
        + weights.touch * (future.touch[:, 1:] - touch).square().sum(-1).mean()
        + weights.contact
        * functional.binary_cross_entropy_with_logits(future.contact[:, 1:], contact.float())
        + weights.taxels
        * functional.binary_cross_entropy_with_logits(
            core.taxels(future.pattern[few, 1:]), felt.float()
        )
        + weights.success
        * functional.binary_cross_entropy_with_logits(future.success[:, -1], success)
    )


def _in_float32(future: SceneFuture) -> SceneFuture:
    objects = future.objects
    return SceneFuture(
        ObjectPoses(objects.position_m.float(), objects.axes.float(), objects.present.float()),
        future.touch.float(),
        future.contact.float(),
        future.pattern.float(),
        future.success.float(),
    )


def _stand(objects: ObjectPoses, held: Bool[Tensor, " batch"]) -> ObjectPoses:
    def still(values: Tensor) -> Tensor:
        chosen = held.view(-1, *[1] * (values.ndim - 1))
        return torch.where(chosen, values[:, :1].expand_as(values), values)

    return replace(objects, position_m=still(objects.position_m), axes=still(objects.axes))


def _object_error(
    predicted: ObjectPoses, true: ObjectPoses, seen: Float32[Tensor, "batch objects"]
) -> Float32[Tensor, ""]:
    """Errors of positions (twice) and axes of objects present now and seen at the start."""
    weight = true.present * (seen > 0.5)[:, None]
    position = functional.smooth_l1_loss(
        predicted.position_m / _UNIT_M, true.position_m / _UNIT_M, beta=0.2, reduction="none"
    ).sum(-1)
    axes = (predicted.axes - true.axes).square().sum((-1, -2))
    return ((2.0 * position + axes) * weight).sum() / weight.sum().clamp_min(1.0)


@torch.no_grad()
def touch_latents(codec: TouchCodec, table: SceneTable) -> Tensor:
    """Latents of all touch of a table, as float16 to save memory."""
    return torch.stack([codec.encode(touch.float()).half() for touch in table.tactile_kpa])
