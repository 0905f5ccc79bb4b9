"""Held-out demonstrations of the twin, generated on the fly as ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from benchmarks.evaluator.playing import start_in_twin
from dextouch.schemas import CHUNK_STEPS, RolloutStart
from dextouch.streams import HEAD_CAMERA
from services.twin.scripted_actions import script_name, scripted_actions
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld


@dataclass(frozen=True)
class HeldOut:
    """One demonstration: its start, its commanded actions, and the true images and touch.

    Row i of `actions`, `images` and `tactile_kpa` belongs to step i + 1.
    """

    start: RolloutStart
    actions: Float64[np.ndarray, "steps 67"]
    images: UInt8[np.ndarray, "steps h w 3"]
    tactile_kpa: Float32[np.ndarray, "steps 2 320"]

    @property
    def chunks(self) -> list[Float64[np.ndarray, "16 67"]]:
        """The actions in chunks of 16 steps; a shorter remainder is dropped."""
        whole = len(self.actions) // CHUNK_STEPS
        return [self.actions[CHUNK_STEPS * k :][:CHUNK_STEPS] for k in range(whole)]


def held_out(tasks: Sequence[str], seeds: Sequence[int], image_px: int) -> list[HeldOut]:
    """The twin's demonstrations of tasks and seeds, seen by the head camera in square images."""
    settings = TwinSettings(
        cameras=(HEAD_CAMERA,), image_height_px=image_px, image_width_px=image_px
    )
    world = TwinWorld(settings)
    return [_played(world, task, seed) for task in tasks for seed in seeds]


def _played(world: TwinWorld, task: str, seed: int) -> HeldOut:
    stage = world.stage(task)
    begun, start, _ = start_in_twin(world, task, seed, stage.task.instruction)
    actions = scripted_actions(stage, seed, script_name(0.0))
    state, seen = begun.state, []
    for first in range(0, len(actions), CHUNK_STEPS):
        stepped = world.step(state, actions[first : first + CHUNK_STEPS], seed=0)
        state = stepped.state
        seen.append(stepped.observation)
    images = np.concatenate([one.images[HEAD_CAMERA] for one in seen])
    return HeldOut(start, actions, images, np.concatenate([one.tactile_kpa for one in seen]))
