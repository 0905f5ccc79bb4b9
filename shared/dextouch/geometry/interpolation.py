"""Interpolation of values and poses in time, with gap detection."""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import rotation_from_vector, vector_from_rotation
from dextouch.geometry.transforms import transform


def bracket(
    t_ns: np.ndarray, at_ns: np.ndarray, *, max_gap_ns: int
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Bracket each query time by two strictly increasing sample times.

    Args:
        t_ns: sample times [m ≥ 2], int64 nanoseconds, strictly increasing.
        at_ns: query times [n] on the same clock.
        max_gap_ns: no interpolation between neighbours further apart than this.

    Returns:
        Left index [n] (0 … m-2), weight of the right neighbour [n] in [0, 1], and whether the query
        lies within the samples and not in a gap.

    Raises:
        InvalidInputError: fewer than two samples, or times that do not increase.
    """
    t = np.asarray(t_ns, dtype=np.int64)
    at = np.asarray(at_ns, dtype=np.int64)
    if t.size < 2 or (np.diff(t) <= 0).any():
        raise InvalidInputError(
            f"interpolation: got {t.size} sample times, expected at least 2, strictly increasing"
        )
    left = np.clip(np.searchsorted(t, at, side="right") - 1, 0, t.size - 2)
    span = t[left + 1] - t[left]
    weight = (at - t[left]) / span
    valid = (at >= t[0]) & (at <= t[-1]) & ((span <= max_gap_ns) | (at == t[left]))
    return left, np.clip(weight, 0.0, 1.0), valid


def interpolate_linear(
    values: np.ndarray, left: np.ndarray, weight: np.ndarray
) -> Float64[np.ndarray, "..."]:
    """Interpolate values [m, ...] linearly at brackets from `bracket`."""
    values = np.asarray(values, dtype=np.float64)
    w = weight.reshape(-1, *([1] * (values.ndim - 1)))
    return (1 - w) * values[left] + w * values[left + 1]


def interpolate_poses(
    Ts: np.ndarray, left: np.ndarray, weight: np.ndarray
) -> Float64[np.ndarray, "n 4 4"]:
    """Linear translation and geodesic rotation (SLERP) of Ts [m, 4, 4] at brackets."""
    Ts = np.asarray(Ts, dtype=np.float64)
    R0, R1 = Ts[left, :3, :3], Ts[left + 1, :3, :3]
    step = vector_from_rotation(np.swapaxes(R0, -1, -2) @ R1)
    R = R0 @ rotation_from_vector(step * weight[:, None])
    w = weight[:, None]
    return transform(R, (1 - w) * Ts[left, :3, 3] + w * Ts[left + 1, :3, 3])


def nearest_index(t_ns: np.ndarray, at_ns: np.ndarray) -> Int64[np.ndarray, " n"]:
    """Index of the sample nearest in time to each query; ties take the earlier sample."""
    t = np.asarray(t_ns, dtype=np.int64)
    at = np.asarray(at_ns, dtype=np.int64)
    right = np.clip(np.searchsorted(t, at), 0, t.size - 1)
    left = np.clip(right - 1, 0, t.size - 1)
    return np.where(at - t[left] <= t[right] - at, left, right).astype(np.int64)
