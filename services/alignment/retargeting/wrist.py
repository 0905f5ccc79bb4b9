"""Wrist and head poses over time in, their 9-D motion relative to the first step out."""

import numpy as np
from jaxtyping import Float64

from dextouch.geometry.rotations import rotation_angle
from dextouch.geometry.transforms import invert
from dextouch.hands.actions import relative_pose_9d


def wrist_motion_9d(
    Ts_world_tracker: np.ndarray, *, T_tracker_wrist: np.ndarray
) -> Float64[np.ndarray, "time 9"]:
    """Relative wrist motion from the poses of a tracker that is strapped on somewhere else.

    Args:
        Ts_world_tracker: [T ≥ 1, 4, 4].
        T_tracker_wrist: where the wrist sits in the tracker's frame.
    """
    return relative_pose_9d(np.asarray(Ts_world_tracker, dtype=np.float64) @ T_tracker_wrist)


def pose_difference(
    Ts_world_a: np.ndarray, Ts_world_b: np.ndarray
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Distance (m) and angle (rad) between two poses of each moment."""
    Ts_world_a = np.asarray(Ts_world_a, dtype=np.float64)
    Ts_world_b = np.asarray(Ts_world_b, dtype=np.float64)
    distance = np.linalg.norm(Ts_world_a[:, :3, 3] - Ts_world_b[:, :3, 3], axis=-1)
    T_a_b = invert(Ts_world_a) @ Ts_world_b
    return np.asarray(distance), rotation_angle(T_a_b[:, :3, :3])
