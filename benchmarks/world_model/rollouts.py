"""Held-out demonstrations of the twin, and imagined rollouts of them: time and errors."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from benchmarks.evaluator.playing import start_in_twin
from dextouch.metrics.tactile import contact_f1
from dextouch.schemas import CHUNK_STEPS, EVERYTHING, Observation, ReturnSelector, RolloutStart
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import BatchWorld, World
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


@dataclass(frozen=True)
class Imagined:
    """All rollouts of one world: the observation of each chunk, and milliseconds per chunk."""

    seen: list[list[Observation]]
    ms: float


@dataclass(frozen=True)
class RolloutError:
    """Errors of whole rollouts relative to the twin: RMS errors, and F1 of taxel contact."""

    image_levels: float
    touch_kpa: float
    contact_f1: float


def imagine(
    world: World[Any], episodes: Sequence[HeldOut], selector: ReturnSelector = EVERYTHING
) -> Imagined:
    """Play every episode's actions, each chunk from the predicted end of the previous one."""
    states = [world.reset(episode.start).state for episode in episodes]
    seen: list[list[Observation]] = [[] for _ in episodes]
    num_chunks = 0
    begin_s = time.process_time()
    for index, episode in enumerate(episodes):
        for chunk, actions in enumerate(episode.chunks):
            stepped = world.step(states[index], actions, seed=chunk, selector=selector)
            states[index] = stepped.state
            seen[index].append(stepped.observation)
            num_chunks += 1
    elapsed_s = time.process_time() - begin_s
    return Imagined(seen, 1e3 * elapsed_s / num_chunks)


def imagine_together(
    world: BatchWorld[Any], episodes: Sequence[HeldOut], num_rollouts: int, selector: ReturnSelector
) -> Imagined:
    """Several rollouts in one batch, of the episodes in turn; milliseconds per rollout's chunk."""
    played = [episodes[index % len(episodes)] for index in range(num_rollouts)]
    states = [world.reset(episode.start).state for episode in played]
    num_chunks = min(len(episode.chunks) for episode in played)
    begin_s = time.process_time()
    for chunk in range(num_chunks):
        stepped = world.step_batch(
            states,
            np.stack([episode.chunks[chunk] for episode in played]),
            seeds=range(num_rollouts),
            selectors=[selector] * num_rollouts,
        )
        states = [one.state for one in stepped]
    elapsed_s = time.process_time() - begin_s
    return Imagined([], 1e3 * elapsed_s / (num_rollouts * num_chunks))


def rollout_error(imagined: Imagined, episodes: Sequence[HeldOut]) -> RolloutError:
    """Errors of rollouts with all images relative to the twin."""
    all_seen = [one for seen in imagined.seen for one in seen]
    pairs = zip(imagined.seen, episodes, strict=True)
    lengths = [(episode, CHUNK_STEPS * len(seen)) for seen, episode in pairs]
    images = np.concatenate([one.images[HEAD_CAMERA] for one in all_seen])
    true_images = np.concatenate([episode.images[:length] for episode, length in lengths])
    off_levels = images.astype(np.float64) - true_images
    touch = np.concatenate([one.tactile_kpa for one in all_seen])
    true_touch = np.concatenate([episode.tactile_kpa[:length] for episode, length in lengths])
    off_kpa = touch.astype(np.float64) - true_touch
    return RolloutError(
        image_levels=float(np.sqrt(np.mean(off_levels**2))),
        touch_kpa=float(np.sqrt(np.mean(off_kpa**2))),
        contact_f1=contact_f1(predicted_kpa=touch, true_kpa=true_touch),
    )
