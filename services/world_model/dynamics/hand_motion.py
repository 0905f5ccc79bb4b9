"""Hand and head camera motion in the world for given actions; the input of the core."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64

from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, AnchorPoses, poses_from_actions
from dextouch.hands.robot_hand import chain_points_of_both_m

# Of each hand: the wrist, five fingertips, five PIP joints, and the middle of the palm.
NUM_POINTS: Final = 12


@dataclass(frozen=True)
class HandMotion:
    """Both hands over n steps in the world frame, left before right.

    `points_m` are the wrist, thumb … little fingertip, their PIP joints, and a point halfway
    between the wrist and the knuckles; `axes` the first two columns of
    R_world_wrist; `Ts_world_camera` the head camera's poses.
    """

    points_m: Float32[np.ndarray, "n 2 12 3"]
    axes: Float32[np.ndarray, "n 2 6"]
    joints_rad: Float32[np.ndarray, "n 2 20"]
    Ts_world_camera: Float64[np.ndarray, "n 4 4"]

    def __len__(self) -> int:
        return len(self.points_m)

    def __getitem__(self, steps: slice | np.ndarray) -> "HandMotion":
        """Select steps."""
        return HandMotion(
            self.points_m[steps],
            self.axes[steps],
            self.joints_rad[steps],
            self.Ts_world_camera[steps],
        )


def hand_motion(
    actions: Float64[np.ndarray, "n 67"], anchor: AnchorPoses, *, validated: bool = False
) -> HandMotion:
    """Motion of both hands under the given actions.

    Args:
        actions: relative to `anchor`.
        anchor: T_world poses that the actions are relative to.
        validated: the actions were returned by `check_actions` and are not checked again.

    Raises:
        DegenerateRotationError: the actions contain a degenerate rotation.
    """
    poses = poses_from_actions(actions, anchor, validated=validated)
    Ts = np.stack([poses.Ts_world_wrist_left, poses.Ts_world_wrist_right], axis=1)
    joints = np.stack([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1)
    chains = chain_points_of_both_m(joints)
    knuckles, pips, tips = chains[..., 0, :], chains[..., 1, :], chains[..., 3, :]
    palm = 0.5 * knuckles[:, :, 1:].mean(axis=2, keepdims=True)
    R = Ts[..., :3, :3]
    points = np.concatenate([np.zeros_like(palm), tips, pips, palm], axis=2)
    points = points @ np.swapaxes(R, -1, -2) + Ts[:, :, None, :3, 3]
    axes = np.concatenate([R[..., 0], R[..., 1]], axis=-1)
    return HandMotion(
        points.astype(np.float32),
        axes.astype(np.float32),
        joints.astype(np.float32),
        poses.Ts_world_camera_head,
    )
