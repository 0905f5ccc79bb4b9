"""The four points of every finger (knuckle, PIP, DIP, tip) taken from tracked keypoints."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import ShapeError
from dextouch.hands import CHAINS, NUM_KEYPOINTS, solver_indices

_NODES = np.array([solver_indices(chain) for chain in CHAINS])


class FingerPoints(NamedTuple):
    """Knuckle, PIP, DIP and tip of thumb … little (of the thumb: CMC, MCP, IP, tip).

    Attributes:
        points_m: wrist axes; zero where not usable.
        usable: finite and trusted by the tracker.
    """

    points_m: Float64[np.ndarray, "time 5 4 3"]
    usable: Bool[np.ndarray, "time 5 4"]


def finger_points(keypoints_m: np.ndarray, valid: np.ndarray | None = None) -> FingerPoints:
    """Select the points of every finger from keypoints.

    Args:
        keypoints_m: [T ≥ 1, 25, 3], order of `dextouch.hands.NODES`; NaN or infinity marks a
            missing node.
        valid: bool [T, 25], validity reported by the tracker; None trusts every finite node.

    Raises:
        ShapeError: not [T ≥ 1, 25, 3], or `valid` not [T, 25].
    """
    keypoints = checked_keypoints(keypoints_m)
    points = keypoints[:, _NODES]
    usable = np.isfinite(points).all(axis=-1)
    if valid is not None:
        if np.shape(valid) != keypoints.shape[:2]:
            raise ShapeError(
                f"keypoints: got valid {np.shape(valid)}, expected {keypoints.shape[:2]}"
            )
        usable &= np.asarray(valid, dtype=bool)[:, _NODES]
    points[~usable] = 0.0
    return FingerPoints(points, usable)


def checked_keypoints(keypoints_m: np.ndarray) -> Float64[np.ndarray, "time 25 3"]:
    """The keypoints as contiguous float64.

    Raises:
        ShapeError: not [T ≥ 1, 25, 3].
    """
    keypoints = np.ascontiguousarray(keypoints_m, dtype=np.float64)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (NUM_KEYPOINTS, 3) or not len(keypoints):
        raise ShapeError(f"keypoints: got shape {keypoints.shape}, expected [T ≥ 1, 25, 3]")
    return keypoints
