"""Places at which poses were recorded, and whether residuals change from one place to the next.

A tracker errs alike as long as it stands still: views of one place are averaged to one. Residuals
that follow the order of the places tell of a mount that slipped, a target or a frame that moved,
and poses of other times.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import fdtrc

from dextouch.errors import InvalidInputError
from dextouch.geometry import invert
from dextouch.geometry.rotations import rotation_angle
from services.alignment.calibration.motion import (
    MIN_VIEWS,
    Series,
    nearest_pose,
    twist,
)

# Directions of which the fitted unknowns leave less than this say nothing of their own.
MIN_INDEPENDENCE = 1e-4
# Fitted unknowns may be nearly the same, of which a fit makes use to the last digit.
MIN_INDEPENDENCE_OF_FITTED = 1e-10
# Views belong to one place where both series moved less. Ten times and more the noise of a tracker,
# and what a hand sways that holds a camera; the mean of such poses is exact to 0.1 mm.
MAX_SAME_PLACE_RAD, MAX_SAME_PLACE_M = np.deg2rad(2.0), 0.01
# Probability that a healthy calibration is refused for a change.
MAX_CHANCE = 1e-6
# Changes that are smaller than this many lengths of the expected noise are part of the sigmas.
MIN_CHANGE = 2.0
# Of neighbours; independent errors have less in 98 of 100 series.
MIN_CORRELATION_SIGMAS = 2.0
# Places on either side of a change; a pose has as many numbers as one of them.
MIN_SIDE = 3


def place_labels(series: Series, *, min_places: int = MIN_VIEWS) -> Int64[np.ndarray, " n"]:
    """Number of the place of each view, in the order in which they were first visited.

    Raises InvalidInputError: fewer than `min_places` places.
    """
    labels = np.full(len(series.Ts_world_body), -1)
    num_places = 0
    for index in range(len(labels)):
        if labels[index] < 0:
            is_near = np.ones(len(labels), dtype=np.bool_)
            for Ts in (series.Ts_world_body, series.Ts_mounted_target):
                apart = invert(Ts[index]) @ Ts
                is_near &= rotation_angle(apart[:, :3, :3]) < MAX_SAME_PLACE_RAD
                is_near &= (
                    np.linalg.norm(Ts[:, :3, 3] - Ts[index, :3, 3], axis=1) < MAX_SAME_PLACE_M
                )
            labels[is_near & (labels < 0)] = num_places
            num_places += 1
    if num_places < min_places:
        raise InvalidInputError(
            f"{series.task}: {len(labels)} views are of {num_places} places, expected at least "
            f"{min_places}, better 20: views within {np.rad2deg(MAX_SAME_PLACE_RAD):.0f} degrees "
            f"and {MAX_SAME_PLACE_M * 1e3:.0f} mm of each other count once"
        )
    return labels


def mean_series(series: Series, labels: np.ndarray) -> Series:
    """One view for each place, the mean of its views."""
    means = [
        np.array([nearest_pose(Ts[labels == place]) for place in range(labels.max() + 1)])
        for Ts in (series.Ts_world_body, series.Ts_mounted_target)
    ]
    return series._replace(Ts_world_body=means[0], Ts_mounted_target=means[1])


def excess_over_time(
    series: Series,
    residuals: Float64[np.ndarray, "n 6"],
    J: Float64[np.ndarray, "n 6 13"],
    C: Float64[np.ndarray, "n 6 6"],
    free: np.ndarray,
    expected: tuple[float, float],
) -> float:
    """Test whether mount, target and clock are the same at all places, in their order.

    Args:
        series: of places.
        residuals: [n, 6] twists that are left, whitened.
        J: how they change with mount, target and scale.
        C: how they change with errors of the body's poses, as twists.
        free: unknowns that were fitted.
        expected: noise of the body's poses, rad and m an axis.

    Returns:
        By how much the variances of what was fitted are larger than independent errors make them.

    Raises:
        InvalidInputError: mount, target or the body's frame moved, or the clocks differ.
    """
    num_places = len(residuals)
    left, fitted = residuals.ravel(), J[:, :, free].reshape(6 * num_places, -1)
    W = series.Ts_world_body
    last, following = np.maximum(np.arange(num_places) - 1, 0), np.arange(1, num_places + 1)
    passed = twist(invert(W[last]) @ W[np.minimum(following, num_places - 1)])
    late = (C @ passed[..., None]).reshape(6 * num_places, 1)
    changes = {}
    for at in range(MIN_SIDE, num_places - MIN_SIDE + 1):
        after = J * (np.arange(num_places) >= at)[:, None, None]
        for name, unknowns in (("mount", slice(6)), ("target", slice(6, 12))):
            functions = after[:, :, unknowns].reshape(6 * num_places, -1)
            changes[name, at] = _change(left, fitted, functions)
    changes["clock", 0] = _change(left, fitted, late)
    (name, at), worst = min(changes.items(), key=lambda change: change[1].p_value)
    size = worst.coefficients
    size = (
        size.reshape(2, 3)
        if name != "clock"
        else size * np.sqrt(np.square(passed).mean(axis=0)).reshape(2, 3)
    )
    is_large = np.linalg.norm(size, axis=1) > MIN_CHANGE * np.sqrt(3) * np.array(expected)
    if worst.p_value * len(changes) < MAX_CHANCE and is_large.any():
        raise InvalidInputError(_refusal(series, name, at, worst))
    times = np.linspace(-1, 1, num_places)[:, None, None]
    trends = (times * J[:, :, :12]).reshape(6 * num_places, -1)
    found = structure(left, fitted, np.column_stack([trends, late]))
    return max(found.ratio, _num_together(left), 1.0)


class Structure(NamedTuple):
    """How much of the residuals some functions explain.

    Attributes:
        ratio: mean square of what they explain over that of the rest (an F statistic).
        p_value: how probable so large a ratio is for independent Gaussian errors.
        explained: sum of squares that they explain.
        rest: mean square of what they do not, by each of its `freedom` degrees of freedom.
        coefficients: of the functions, by least squares.
        remaining: residuals that they do not explain.
    """

    ratio: float
    p_value: float
    explained: float
    rest: float
    freedom: int
    coefficients: Float64[np.ndarray, " m"]
    remaining: Float64[np.ndarray, " n"]


def structure(
    residuals: Float64[np.ndarray, " n"],
    fitted: Float64[np.ndarray, "n p"],
    functions: Float64[np.ndarray, "n m"],
    *,
    num_others: int = 0,
    num_together: float = 1.0,
) -> Structure:
    """Test whether functions explain residuals of a fit better than chance.

    Independent errors leave as much in any direction of the residuals as in any other.

    Args:
        residuals: of one size of error each (whitened).
        fitted: how the residuals change with the unknowns that were fitted.
        functions: what the residuals might follow.
        num_others: fitted unknowns of which nothing is left in all three.
        num_together: how many errors in turn are alike, and count as one.
    """
    U, s, _ = np.linalg.svd(fitted / _lengths(fitted), full_matrices=False)
    Q = U[:, s > MIN_INDEPENDENCE_OF_FITTED]
    lengths = _lengths(functions)
    own = functions / lengths
    own, left = own - Q @ (Q.T @ own), residuals - Q @ (Q.T @ residuals)
    U, s, Vt = np.linalg.svd(own, full_matrices=False)
    U, s, Vt = (part[s > MIN_INDEPENDENCE] for part in (U.T, s, Vt))
    along = U @ left
    explained, num = float(along @ along), len(s)
    freedom = max(len(residuals) - num_others - Q.shape[1] - num, 1)
    rest = max(float(left @ left) - explained, np.finfo(float).tiny) / freedom
    ratio = explained / max(num, 1) / rest / num_together
    p_value = float(fdtrc(max(num, 1), freedom / num_together, ratio))
    return Structure(
        ratio, p_value, explained, rest, freedom, (Vt.T @ (along / s)) / lengths, left - U.T @ along
    )


def _lengths(columns: np.ndarray) -> np.ndarray:
    return np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)


def _change(left: np.ndarray, fitted: np.ndarray, functions: np.ndarray) -> Structure:
    """Test for a change among errors that may be alike from one place to the next."""
    found = structure(left, fitted, functions)
    return structure(left, fitted, functions, num_together=_num_together(found.remaining))


def _num_together(residuals: np.ndarray) -> float:
    """How many places in turn err alike, from the correlation of neighbours (1 if by chance).

    A tracker whose error varies smoothly over the room errs so (autoregressive, first order).
    """
    errors = residuals.reshape(-1, 6)
    correlation = float((errors[1:] * errors[:-1]).sum() / np.square(errors).sum())
    if correlation < MIN_CORRELATION_SIGMAS / np.sqrt(errors.size):
        return 1.0
    return (1 + correlation) / (1 - correlation)


def _refusal(series: Series, name: str, at: int, worst: Structure) -> str:
    turn_deg = np.rad2deg(np.linalg.norm(worst.coefficients[:3]))
    if name == "clock":
        return (
            f"{series.task}: the poses of {series.names[0]} are of other times than those of "
            f"{series.names[1]}, by {abs(worst.coefficients[0]) * 2:.2f} of the time from one "
            "place to the next; hold still for each view, or calibrate the time offset first"
        )
    moved = {
        "mount": f"the mount on the {series.body} slipped",
        "target": f"the target or the frame of {series.names[0]} moved",
    }[name]
    return (
        f"{series.task}: {moved} by {turn_deg:.2f} degrees and "
        f"{np.linalg.norm(worst.coefficients[3:]) * 1e3:.1f} mm before place {at} of "
        f"{len(series.Ts_world_body)}, in the order of the views; fasten it and take all views anew"
    )
