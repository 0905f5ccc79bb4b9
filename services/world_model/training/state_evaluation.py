"""Accuracy of a dynamics model on held-out scenes: open-loop rollouts from several starts."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from dextouch.errors import InvalidInputError
from dextouch.metrics import tactile as tactile_metrics
from dextouch.schemas import CHUNK_STEPS
from dextouch.tactile.layout import TactileLayout
from services.world_model.dynamics.features import STEPS_PER_LATENT
from services.world_model.dynamics.model import DynamicsModel, ImaginedSteps, batched
from services.world_model.training.reader_training import reader_errors
from services.world_model.training.scene_table import SceneTable

# Start steps of rollouts, as far as they have images.
STARTS = (0, 16, 32, 48, 64)
_BATCH = 64
# Bounds are this quantile over held-out chunks of 16 steps from any start, so that at most one in
# 200 episodes of five chunks exceeds one.
_BOUND_QUANTILE = 0.999
_SMALLEST_DISTANCE = 1e-3


@dataclass(frozen=True)
class StateFigures:
    """Measured accuracy, with the bounds that almost no held-out chunk exceeds.

    `figures` hold errors of readers (first member) and objects (median at a chunk's end) in mm, and
    contact F1 and error of touch by chunks of 16 steps. Names with `from_16` are of starts at step
    16.
    """

    figures: dict[str, float]
    disagreement_m: float
    distance: float


def evaluate_dynamics(dynamics: DynamicsModel, table: SceneTable) -> StateFigures:
    """Predict every episode from its first step and from later ones, and compare."""
    figures: dict[str, float] = {}
    disagreement_m, distance = [], []
    if int(table.length.max()) <= CHUNK_STEPS:
        raise InvalidInputError(
            f"state model: the longest held-out episode has {int(table.length.max())} steps, "
            f"expected more than the {CHUNK_STEPS} of a chunk"
        )
    last_start = table.num_steps - 1 - STEPS_PER_LATENT
    for start in (s for s in STARTS if s in table.image_steps and s <= last_start):
        imagined = _imagined(dynamics, table, start)
        figures |= _chunk_figures(imagined, table, start, dynamics.config.tactile_layout)
        if start == 0:
            figures |= _episode_figures(imagined, table, dynamics)
        within = table.within(torch.arange(len(table)), start)
        disagreement_m.append(chunk_peaks(imagined.disagreement_m, within))
        distance.append(chunk_peaks(imagined.distance, within))
    return StateFigures(
        {name: round(float(value), 4) for name, value in figures.items()},
        disagreement_m=float(torch.cat(disagreement_m).quantile(_BOUND_QUANTILE)),
        distance=max(_SMALLEST_DISTANCE, float(torch.cat(distance).quantile(_BOUND_QUANTILE))),
    )


def chunk_peaks(
    latents: Float32[Tensor, "episodes latents"], within: Bool[Tensor, "episodes latents"]
) -> Float32[Tensor, " chunks"]:
    """Maximum of each chunk of 16 steps that lies within its episode."""
    size = CHUNK_STEPS // STEPS_PER_LATENT
    pairs = zip(torch.split(latents, size, dim=1), torch.split(within, size, dim=1), strict=True)
    return torch.cat([chunk.amax(1)[inside.all(1)] for chunk, inside in pairs])


def _chunk_figures(
    imagined: ImaginedSteps, table: SceneTable, start: int, layout: TactileLayout
) -> dict[str, float]:
    figures: dict[str, float] = {}
    place = "" if start == 0 else f"from_{start}_"
    for index, first in enumerate(range(start, table.num_steps - 1, CHUNK_STEPS)):
        end = min(first + CHUNK_STEPS, table.num_steps - 1)
        # Of shorter episodes, chunks that go beyond their end are left out.
        whole = table.length > end
        if not whole.any():
            break
        steps, predicted = (slice(k, k + CHUNK_STEPS) for k in (first + 1, first - start))
        true = table.tactile_kpa[whole, steps].float().numpy()
        measured = table.felt[whole, steps, :, None] & table.measured_taxels[whole, None]
        guesses = {"": imagined.tactile_kpa[whole, predicted].numpy()}
        if start == 0:
            before = table.tactile_kpa[whole, first : first + 1].float().numpy()
            guesses["_of_copy"] = np.broadcast_to(before, true.shape)
        for name, guess in guesses.items() if measured.any() else ():
            chunk = f"{place}chunk_{index + 1}{name}"
            pair = {"predicted_kpa": guess, "true_kpa": true, "measured": measured.numpy()}
            figures[f"contact_f1_{chunk}"] = tactile_metrics.contact_f1(**pair, layout=layout)
            figures[f"tactile_mse_{chunk}"] = tactile_metrics.mse(**pair, layout=layout)
        position_m = imagined.poses.position_m[:, end - start - 1]
        off_mm, there = _object_errors(position_m, table, start, end)
        if there.any():
            figures[f"object_mm_{place}chunk_{index + 1}"] = float(off_mm[there].median())
    return figures


def _episode_figures(
    imagined: ImaginedSteps, table: SceneTable, dynamics: DynamicsModel
) -> dict[str, float]:
    """Errors of objects at the end and of readers at the start, by task."""
    figures: dict[str, float] = {}
    rows = torch.arange(len(table))
    last = table.length - 1
    off_mm, there = _object_errors(imagined.poses.position_m[rows, last - 1], table, 0, last)
    for index, task in enumerate(dynamics.config.tasks):
        found = there & (table.task == index)[:, None]
        if found.any():
            figures[f"final_object_mm_{task}"] = float(off_mm[found].median())
    return figures | reader_errors(dynamics.readers()[0], table)


def _object_errors(
    position_m: Float32[Tensor, "episodes objects 3"],
    table: SceneTable,
    start: int,
    step: int | Int64[Tensor, " episodes"],
) -> tuple[Tensor, Tensor]:
    """Position errors in mm at a step, and which objects are known to be there at both steps."""
    rows = torch.arange(len(table))
    true = table.objects_at(rows, step)
    there = (true.present > 0) & (table.objects_at(rows, start).present > 0)
    there &= table.objects_known[rows, step] & table.objects_known[:, start]
    return 1e3 * (position_m - true.position_m).norm(dim=-1), there


@torch.no_grad()
def _imagined(dynamics: DynamicsModel, table: SceneTable, start: int) -> ImaginedSteps:
    """Predictions of whole episodes from one start."""
    parts = []
    for rows in torch.split(torch.arange(len(table)), _BATCH):
        first = table.first_steps(rows, torch.full_like(rows, start))
        commands = table.commands(rows, start, torch.zeros(len(rows), dtype=torch.bool))
        touch = table.tactile_kpa[rows, start].float()
        sent = table.commanded[rows].float()
        memory = dynamics.begin(first, touch, commands[:1], sent, table.instruction[rows])
        parts.append(dynamics.advance(memory, commands[1:])[1])
    return batched(parts)
