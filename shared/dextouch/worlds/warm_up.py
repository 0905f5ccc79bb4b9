"""First chunk of a world before its service is ready, since it loads and allocates what all use."""

import time
from typing import Any

import numpy as np

from dextouch.hands.actions import (
    ACTION_DIM,
    IDENTITY_POSE_9D,
    POSE_SLICES,
    WRIST_LEFT,
    AnchorPoses,
)
from dextouch.schemas import Observation, RolloutStart, WorldDescription
from dextouch.worlds.world import World


def first_chunk_s(world: World[Any]) -> float:
    """Start a rollout and advance it by one chunk; returns the duration.

    In a model, a wrist moves by a millimetre, since a scene at rest is not computed.

    Raises DexTouchError if the world begins nothing from black images, or cannot continue.
    """
    began_s = time.perf_counter()
    description = world.description
    started = world.reset(_plain_start(description))
    held = np.repeat(started.observation.action_reached[-1:], description.chunk_multiple, axis=0)
    if description.kind == "model":
        held[:, WRIST_LEFT.start] += 1e-3
    stepped = world.step(started.state, held, seed=0)
    world.restore(world.snapshot(stepped.state))
    return time.perf_counter() - began_s


def _plain_start(description: WorldDescription) -> RolloutStart:
    """A task and seed where the world takes them, otherwise black images and hands at rest."""
    task, kind = description.tasks[0], description.action_kinds[0]
    if "task_seed" in description.starts_from:
        return RolloutStart(task, 0, "", kind)
    height_px, width_px = description.image_height_px, description.image_width_px
    still = np.zeros((1, ACTION_DIM))
    for pose in POSE_SLICES:
        still[:, pose] = IDENTITY_POSE_9D
    images = {
        camera: np.zeros((1, height_px, width_px, 3), np.uint8) for camera in description.cameras
    }
    touch_kpa = np.zeros((1, 2, description.num_taxels), np.float32)
    observation = Observation(
        first_step=0,
        images=images,
        tactile_kpa=touch_kpa,
        action_reached=still,
        reached_is_measured=True,
    )
    K_head = np.array([[width_px, 0, width_px / 2], [0, width_px, height_px / 2], [0, 0, 1.0]])
    anchor = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))
    return RolloutStart(task, 0, "", kind, observation, anchor, K_head)
