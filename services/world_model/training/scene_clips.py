"""Conversion of episodes with object poses to training clips of the renderer."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from dextouch.hands.actions import (
    JOINTS_LEFT,
    JOINTS_RIGHT,
    AnchorPoses,
    poses_from_actions,
)
from services.world_model.dynamics.objects import MAX_DISTANCE_M
from services.world_model.rendering.clips import SceneClip
from services.world_model.rendering.scene_states import SceneStates
from services.world_model.training.scene_episodes import SceneEpisode


def scene_clips(episodes: Sequence[SceneEpisode]) -> list[SceneClip]:
    """Clips of the images of which all objects are known, where an episode has two or more."""
    clips = []
    for episode in episodes:
        shown = np.flatnonzero(episode.objects_known[episode.image_steps].all(axis=1))
        if len(shown) > 1 and len(episode.object_boxes_m):
            clips.append(_clip(episode, shown))
    return clips


def _clip(episode: SceneEpisode, shown: Int64[np.ndarray, " n"]) -> SceneClip:
    steps = episode.image_steps[shown]
    actions = episode.measured_actions[steps]
    hands = poses_from_actions(actions, AnchorPoses(*episode.anchor))
    wrists = (hands.Ts_world_wrist_left, hands.Ts_world_wrist_right)
    poses = episode.object_poses[steps].astype(np.float64)
    return SceneClip(
        steps=steps,
        images=episode.images[shown],
        states=SceneStates(
            Ts_world_camera=hands.Ts_world_camera_head,
            Ts_world_wrist=np.stack(wrists, axis=1),
            joints_rad=np.stack([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1),
            object_poses=poses,
            object_present=np.linalg.norm(poses[..., :3], axis=-1) <= MAX_DISTANCE_M,
        ),
        K_head=episode.K_head,
        boxes_m=episode.object_boxes_m,
    )
