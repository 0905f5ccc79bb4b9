"""Imagined rollouts of held-out demonstrations: processor time and errors."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.world_model.held_out import HeldOut
from dextouch.metrics.tactile import contact_f1
from dextouch.schemas import CHUNK_STEPS, EVERYTHING, Observation, ReturnSelector
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import BatchWorld, World


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
