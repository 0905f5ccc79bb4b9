"""Wrist and head poses over time in; their 9-D motion, or their poses in a robot's base, out."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry.rotations import rotation_angle
from dextouch.geometry.transforms import invert
from dextouch.hands.actions import relative_pose_9d

# How far R Rᵀ of a stored transform may be from the identity.
RIGID_TOLERANCE: Final = 1e-6


def rigid_transform(matrix: object, *, what: str) -> Float64[np.ndarray, "4 4"]:
    """A matrix of a calibration as float64 [4, 4], if it is a rigid transform.

    Args:
        matrix: 4 rows of 4 numbers.
        what: its name, for the message.

    Raises:
        ShapeError: not 4 by 4.
        NonFiniteError: NaN or infinity.
        InvalidInputError: its rotation is none, or mirrors, or the last row is not 0 0 0 1.
    """
    T = np.asarray(matrix, dtype=np.float64)
    if T.shape != (4, 4):
        raise ShapeError(f"{what}: got shape {T.shape}, expected (4, 4)")
    if not np.isfinite(T).all():
        raise NonFiniteError(f"{what}: holds NaN or infinity; calibrate again")
    R = T[:3, :3]
    off, determinant = np.abs(R @ R.T - np.eye(3)).max(), np.linalg.det(R)
    if off > RIGID_TOLERANCE or determinant < 0 or T[3].tolist() != [0, 0, 0, 1]:
        raise InvalidInputError(
            f"{what}: no rigid transform (R Rᵀ is off by {off:.1e}, expected at most "
            f"{RIGID_TOLERANCE:.0e}; det {determinant:+.2f}; last row {T[3].tolist()}); calibrate "
            "again"
        )
    return T


def poses_in_base(
    Ts_world_tracker: np.ndarray, *, T_world_base: np.ndarray, T_tracker_body: np.ndarray
) -> Float64[np.ndarray, "time 4 4"]:
    """Poses of a tracked body in the robot's base: T_base_world · T_world_tracker · T_tracker_body.

    Args:
        Ts_world_tracker: [T, 4, 4] poses of the tracker in the tracked world.
        T_world_base: of `calibration.robot_base.solve_robot_base`.
        T_tracker_body: where the wrist or the head's camera sits on its tracker.

    Raises:
        ShapeError, NonFiniteError, InvalidInputError: what is no [T, 4, 4], or a calibration that
            is no rigid transform.
    """
    Ts = np.asarray(Ts_world_tracker, dtype=np.float64)
    if Ts.ndim != 3 or Ts.shape[1:] != (4, 4):
        raise ShapeError(f"poses of the tracker: got shape {Ts.shape}, expected [T, 4, 4]")
    if not np.isfinite(Ts).all():
        raise NonFiniteError("poses of the tracker: hold NaN or infinity; leave those samples out")
    T_base_world = invert(rigid_transform(T_world_base, what="T_world_base"))
    return T_base_world @ Ts @ rigid_transform(T_tracker_body, what="T_tracker_body")


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
