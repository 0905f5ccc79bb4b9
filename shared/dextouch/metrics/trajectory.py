"""Reached and true poses in; position errors (m) and rotation errors (rad) out."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.geometry.rotations import rotation_angle
from dextouch.metrics.checks import checked_pair


@dataclass(frozen=True)
class PoseError:
    """Errors of a trajectory: root mean square and largest."""

    position_rms_m: float
    position_max_m: float
    rotation_rms_rad: float
    rotation_max_rad: float


def position_errors_m(
    *, reached_m: np.ndarray, true_m: np.ndarray
) -> Float64[np.ndarray, "*batch"]:
    """Distance of every reached point [..., 3] from its true point, in metres."""
    a, b = checked_pair(reached_m, true_m, what="points", tail=(3,))
    return np.asarray(np.linalg.norm(a - b, axis=-1))


def rotation_errors_rad(
    *, R_world_reached: np.ndarray, R_world_true: np.ndarray
) -> Float64[np.ndarray, "*batch"]:
    """Angle in 0 … π between every reached and true rotation [..., 3, 3]."""
    a, b = checked_pair(R_world_reached, R_world_true, what="rotations", tail=(3, 3))
    return np.asarray(rotation_angle(np.swapaxes(b, -1, -2) @ a))


def pose_error(*, Ts_world_reached: np.ndarray, Ts_world_true: np.ndarray) -> PoseError:
    """Errors of poses [..., 4, 4] at the same times.

    Raises:
        ShapeError: different shapes, or not [..., 4, 4].
        NonFiniteError: NaN or infinity.
    """
    a, b = checked_pair(Ts_world_reached, Ts_world_true, what="poses", tail=(4, 4))
    position = position_errors_m(reached_m=a[..., :3, 3], true_m=b[..., :3, 3])
    rotation = rotation_errors_rad(R_world_reached=a[..., :3, :3], R_world_true=b[..., :3, :3])
    return PoseError(
        float(np.sqrt(np.mean(position**2))),
        float(np.max(position)),
        float(np.sqrt(np.mean(rotation**2))),
        float(np.max(rotation)),
    )
