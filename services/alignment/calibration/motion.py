"""Checks that the poses for a calibration rotate enough, about enough axes, to determine it."""

from itertools import combinations

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import invert
from dextouch.geometry.rotations import vector_from_rotation

MIN_VIEWS = 4
MAX_PAIRS = 5000
# The second largest spread of turns must reach this, or part of the mount cannot be seen.
MIN_SECOND_SPREAD_RAD = np.deg2rad(10.0)
# Smallest over largest eigenvalue of what the turns say of the mount's place.
MIN_EIGENVALUE_RATIO = 1e-4
AXIS_NAMES = ("x", "y", "z")


class DegenerateMotionError(InvalidInputError):
    """The motion does not determine the result; the message names the missing motion."""


def checked_poses(task: str, **series: np.ndarray) -> list[Float64[np.ndarray, "n 4 4"]]:
    """Validate series of poses: float64 [n, 4, 4], all of one length.

    Raises:
        ShapeError, NonFiniteError: no [n, 4, 4], or NaN.
        InvalidInputError: no rigid transforms, or fewer than four.
    """
    arrays = {name: np.asarray(poses, dtype=np.float64) for name, poses in series.items()}
    shapes = [array.shape for array in arrays.values()]
    if len(set(shapes)) != 1 or len(shapes[0]) != 3 or shapes[0][1:] != (4, 4):
        raise ShapeError(f"{task}: got poses {shapes}, expected all [n, 4, 4] of one length")
    for name, poses in arrays.items():
        bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
        if bad.size:
            raise NonFiniteError(
                f"{task}: {name} holds NaN or infinity in views {bad[:8].tolist()}; leave those "
                "views out of all series",
                views=bad.tolist(),
            )
        R = poses[:, :3, :3]
        orthogonal = np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-3)
        if not orthogonal or (np.linalg.det(R) < 0).any():
            raise InvalidInputError(f"{task}: {name} holds matrices that are no rigid transforms")
    if shapes[0][0] < MIN_VIEWS:
        raise InvalidInputError(
            f"{task}: got {shapes[0][0]} views, expected at least {MIN_VIEWS}, better 20"
        )
    return list(arrays.values())


def view_pairs(num_views: int) -> np.ndarray:
    """Pairs of views [p, 2]: all of them, or every n-th of very many."""
    pairs = np.array(list(combinations(range(num_views), 2)))
    return pairs[:: max(1, len(pairs) // MAX_PAIRS)]


def check_turns(task: str, body: str, Ts_world_body: np.ndarray) -> None:
    """Refuse poses [n, 4, 4] of a body that turns about a single axis, or hardly at all.

    Raises:
        DegenerateMotionError: names the axes of the body about which it was not turned.
    """
    pairs = view_pairs(len(Ts_world_body))
    A = invert(Ts_world_body[pairs[:, 1]]) @ Ts_world_body[pairs[:, 0]]
    turns_rad = vector_from_rotation(A[:, :3, :3])
    _, spread_rad, axes = np.linalg.svd(turns_rad / np.sqrt(len(turns_rad)), full_matrices=False)
    shown = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    eigenvalues = np.linalg.eigvalsh(shown.T @ shown)
    ratio = float(eigenvalues[0] / eigenvalues[-1]) if eigenvalues[-1] > 0 else 0.0
    if spread_rad[1] >= MIN_SECOND_SPREAD_RAD and ratio >= MIN_EIGENVALUE_RATIO:
        return
    is_seen = spread_rad[0] >= MIN_SECOND_SPREAD_RAD
    names = missing_axes(axes[1:] if is_seen else axes)
    told = "/".join(f"{value:.1f}" for value in np.rad2deg(spread_rad))
    seen = f" (all turns are about {np.round(axes[0], 2).tolist()})" if is_seen else ""
    raise DegenerateMotionError(
        f"{task}: turns of the {body} spread {told} degrees along three axes{seen}, expected the "
        f"second at least {np.rad2deg(MIN_SECOND_SPREAD_RAD):.0f}; also turn the {body} by 30 "
        f"degrees and more about its {' and '.join(names)} axis",
        spread_deg=[float(value) for value in np.rad2deg(spread_rad)],
        eigenvalue_ratio=ratio,
        missing_axes=names,
    )


def missing_axes(missing: np.ndarray) -> list[str]:
    """Names of the axes closest to the m missing directions [m, 3]."""
    depth = np.square(missing).sum(axis=0)
    deepest = sorted(np.argsort(-depth, kind="stable")[: len(missing)])
    return [AXIS_NAMES[index] for index in deepest]
