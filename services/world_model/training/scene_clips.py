"""Conversion of episodes with object poses to training clips of the renderer."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.episodes import EpisodeGrid
from dextouch.hands.actions import (
    JOINTS_LEFT,
    JOINTS_RIGHT,
    poses_from_actions,
)
from services.world_model.dynamics.objects import MAX_DISTANCE_M
from services.world_model.rendering.clips import SceneClip
from services.world_model.rendering.scene_states import SceneStates


def scene_clips(episodes: Sequence[EpisodeGrid]) -> list[SceneClip]:
    """Clips of the images of which all objects are known, where an episode has two or more."""
    clips = []
    for episode in episodes:
        if (track := episode.objects) is None or not len(episode.boxes_m):
            continue
        steps = episode.image_steps[track.known[episode.image_steps].all(axis=1)]
        if len(steps) > 1:
            clips.append(_clip(episode, steps, track.poses[steps].astype(np.float64)))
    return clips


def _clip(
    episode: EpisodeGrid,
    steps: Int64[np.ndarray, " n"],
    poses: Float64[np.ndarray, "n objects 7"],
) -> SceneClip:
    actions = episode.measured[steps]
    hands = poses_from_actions(actions, episode.anchor)
    wrists = (hands.Ts_world_wrist_left, hands.Ts_world_wrist_right)
    return SceneClip(
        steps=steps,
        images=episode.images(steps),
        states=SceneStates(
            Ts_world_camera=hands.Ts_world_camera_head,
            Ts_world_wrist=np.stack(wrists, axis=1),
            joints_rad=np.stack([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1),
            object_poses=poses,
            object_present=np.linalg.norm(poses[..., :3], axis=-1) <= MAX_DISTANCE_M,
        ),
        K_head=episode.K_head,
        boxes_m=episode.boxes_m,
    )
