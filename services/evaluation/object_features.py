"""Features of object poses that predict success: heights, axes, relative positions, motion.

Success is decided by millimetres within half a metre, so distances enter twice: linearly, and
compressed by asinh.
"""

from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Float64

from dextouch.errors import ShapeError
from dextouch.geometry import invert, transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import MAX_OBJECTS

_PAIRS: Final = tuple(combinations(range(MAX_OBJECTS), 2))
_WIDE_M, _NEAR_M, _STILL_M, _STILL_RAD = 0.1, 0.01, 0.002, 0.05
_OF_OBJECT, _OF_PAIR = 17, 18
NUM_OBJECT_FEATURES: Final = MAX_OBJECTS * _OF_OBJECT + len(_PAIRS) * _OF_PAIR


def object_features(object_poses: np.ndarray) -> Float32[np.ndarray, "105"]:
    """Features of the poses at the last steps; an absent object and its pairs give zeros.

    Args:
        object_poses: T_world_object [steps, objects ≤ 3, 7] (x y z m, qw qx qy qz), the last step
            being the current one. An object with a non-finite number or a zero quaternion counts as
            absent.

    Raises:
        ShapeError: other shapes, or more objects.
    """
    poses = np.asarray(object_poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[2] != 7 or not 0 < poses.shape[1] <= MAX_OBJECTS:
        raise ShapeError(
            f"object poses: got shape {poses.shape}, expected [steps, 1 … {MAX_OBJECTS}, 7]"
        )
    present = known_objects(poses)
    safe = np.where(present[:, None], poses, np.array([0.0, 0, 0, 1, 0, 0, 0]))
    T = transform_from_pose(safe)
    parts = []
    for slot in range(MAX_OBJECTS):
        there = slot < len(present) and bool(present[slot])
        parts.append(_of_object(T[:, slot]) if there else np.zeros(_OF_OBJECT))
    for first, second in _PAIRS:
        there = second < len(present) and bool(present[first] and present[second])
        pair = _of_pair(T[-1, first], T[-1, second]) if there else np.zeros(_OF_PAIR)
        parts.append(pair)
    return np.concatenate(parts).astype(np.float32)


def known_objects(object_poses: np.ndarray) -> Bool[np.ndarray, " objects"]:
    """Mask of objects in poses [steps, objects, 7] that have a pose at every step."""
    finite = np.isfinite(object_poses).all(axis=(0, 2))
    length = np.linalg.norm(np.nan_to_num(object_poses[..., 3:]), axis=-1)
    return np.asarray(finite & (length > 1e-6).all(axis=0))


def _of_object(Ts_world_object: np.ndarray) -> Float64[np.ndarray, "17"]:
    T = Ts_world_object[-1]
    moved_m = T[:3, 3] - Ts_world_object[0, :3, 3]
    turned_rad = rotation_angle(T[:3, :3] @ Ts_world_object[0, :3, :3].T)
    return np.concatenate(
        [
            [1.0, np.arcsinh(T[2, 3] / _NEAR_M)],
            T[:3, 3] / _WIDE_M,
            T[:3, :3].ravel(),
            [
                np.arcsinh(np.linalg.norm(moved_m) / _STILL_M),
                np.arcsinh(moved_m[2] / _STILL_M),
                np.arcsinh(float(turned_rad) / _STILL_RAD),
            ],
        ]
    )


def _of_pair(T_world_a: np.ndarray, T_world_b: np.ndarray) -> Float64[np.ndarray, "18"]:
    """Second object relative to the first, and their horizontal and vertical distance."""
    T_a_b = invert(T_world_a) @ T_world_b
    apart_m = T_world_b[:3, 3] - T_world_a[:3, 3]
    return np.concatenate(
        [
            [1.0],
            T_a_b[:3, 3] / _WIDE_M,
            np.arcsinh(T_a_b[:3, 3] / _NEAR_M),
            T_a_b[:3, :3].ravel(),
            [
                np.arcsinh(np.linalg.norm(apart_m[:2]) / _NEAR_M),
                np.arcsinh(apart_m[2] / _NEAR_M),
            ],
        ]
    )
