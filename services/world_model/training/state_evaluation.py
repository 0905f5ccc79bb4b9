"""Accuracy of a dynamics model on held-out scenes, open loop over whole episodes."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from dextouch.metrics import tactile as tactile_metrics
from services.world_model.dynamics.configuration import STEPS_PER_LATENT
from services.world_model.dynamics.model import Commands, DynamicsModel
from services.world_model.training.reader_training import reader_errors
from services.world_model.training.scene_table import SceneTable

CHUNK_STEPS = 16
_BATCH = 64
# Of held-out episodes, this share may pass a bound.
_BOUND_QUANTILE = 0.995


@dataclass(frozen=True)
class StateFigures:
    """What was measured, with the bounds that almost no held-out episode passes.

    `figures` hold errors of readers (of the first member) and objects in mm, contact F1 and error
    of touch for each chunk of 16 steps, and those of copying the touch before the chunk.
    """

    figures: dict[str, float]
    disagreement_m: float
    distance: float
    num_latents: int


@dataclass(frozen=True)
class _Imagined:
    tactile_kpa: Float32[Tensor, "episodes steps 2 320"]
    last_m: Float32[Tensor, "episodes objects 3"]
    disagreement_m: Float32[Tensor, " episodes"]
    distance: Float32[Tensor, " episodes"]


def evaluate_dynamics(dynamics: DynamicsModel, table: SceneTable) -> StateFigures:
    """Imagine every episode from its first step and compare."""
    parts = [
        _imagine(dynamics, table, rows) for rows in torch.split(torch.arange(len(table)), _BATCH)
    ]
    tactile = torch.cat([part.tactile_kpa for part in parts]).numpy()
    true = table.tactile_kpa.float().numpy()
    figures: dict[str, float] = {}
    for index, first in enumerate(range(0, true.shape[1] - 1, CHUNK_STEPS)):
        steps = slice(first + 1, first + 1 + CHUNK_STEPS)
        copied = np.broadcast_to(true[:, first : first + 1], true[:, steps].shape)
        for name, guess in (("", tactile[:, first : first + CHUNK_STEPS]), ("_of_copy", copied)):
            pair = {"predicted_kpa": guess, "true_kpa": np.ascontiguousarray(true[:, steps])}
            figures[f"contact_f1_chunk_{index + 1}{name}"] = tactile_metrics.contact_f1(**pair)
            figures[f"tactile_mse_chunk_{index + 1}{name}"] = tactile_metrics.mse(**pair)
    last = torch.cat([part.last_m for part in parts])
    rows = torch.arange(len(table))
    end = table.objects_at(rows, table.num_steps - 1)
    there = (end.present > 0) & (table.objects_at(rows, 0).present > 0)
    off_mm = 1e3 * (last - end.position_m).norm(dim=-1)
    reader = dynamics.readers()[0]
    for task, index in ((t, i) for i, t in enumerate(dynamics.config.tasks)):
        found = there & (table.task == index)[:, None]
        if found.any():
            figures[f"final_object_mm_{task}"] = float(off_mm[found].median())
    for task, error in reader_errors(reader, table, 0).items():
        figures[f"start_lateral_mm_{task}"] = error.lateral_mm
        figures[f"start_lateral_90_mm_{task}"] = error.lateral_90_mm
    quantile = torch.tensor(_BOUND_QUANTILE)
    return StateFigures(
        {name: round(float(value), 4) for name, value in figures.items()},
        disagreement_m=float(torch.cat([p.disagreement_m for p in parts]).quantile(quantile)),
        distance=max(1e-3, float(torch.cat([p.distance for p in parts]).quantile(quantile))),
        num_latents=(table.num_steps - 1) // STEPS_PER_LATENT,
    )


@torch.no_grad()
def _imagine(dynamics: DynamicsModel, table: SceneTable, rows: Tensor) -> _Imagined:
    first = table.first_steps(rows, torch.zeros_like(rows))
    commands = table.commands(rows, 0, torch.zeros(len(rows), dtype=torch.bool))
    standing, following = _split(commands)
    touch = table.tactile_kpa[rows, 0].float()
    memory = dynamics.begin(first, touch, standing, table.commanded[rows].float())
    _, imagined = dynamics.advance(memory, following)
    return _Imagined(
        imagined.tactile_kpa,
        imagined.poses.position_m[:, -1],
        imagined.disagreement_m,
        imagined.distance,
    )


def _split(commands: Commands) -> tuple[Commands, Commands]:
    def parts(first: int | None, last: int | None) -> Commands:
        steps = slice(first, last)
        return Commands(
            commands.points_m[:, steps], commands.axes[:, steps], commands.joints_rad[:, steps]
        )

    return parts(None, 1), parts(1, None)
