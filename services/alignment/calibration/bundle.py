"""Bundle adjustment of hand-eye calibration: mount, target pose and their covariance.

Every view says T_world_tracker · D · X · B = Z, with the mount X, the target's pose Z, the
measured pose B of the target in the mounted frame, and a small correction D of the tracker's
pose, whose size the tracker's noise limits. All are found together by Gauss–Newton with analytic
Jacobians; the corrections, six numbers a view, are eliminated by the Schur complement, so that
the system to solve has 12 unknowns however many views there are.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import invert
from services.alignment.calibration.twists import adjoint, move, twist, twist_jacobian

MAX_ROUNDS = 30
# Steps below this (rad, m) change nothing that could be measured.
SMALLEST_STEP = 1e-10


class Linearised(NamedTuple):
    """Normal equations of a measurement, linearized at predicted poses.

    Attributes:
        information: [n, 6, 6].
        gradient: [n, 6], of half the weighted squares.
    """

    information: Float64[np.ndarray, "n 6 6"]
    gradient: Float64[np.ndarray, "n 6"]


Measurement = Callable[[np.ndarray], Linearised]


@dataclass(frozen=True)
class Bundle:
    """Result of the bundle adjustment.

    Attributes:
        X: the mount.
        Z: the target's pose in the world.
        covariance: of the twists of X, then of Z (rad, m, in their own frames). Rows and columns
            of a mount that was given are zero.
    """

    X: Float64[np.ndarray, "4 4"]
    Z: Float64[np.ndarray, "4 4"]
    covariance: Float64[np.ndarray, "12 12"]


def pose_measurement(Ts_measured: np.ndarray, information: np.ndarray) -> Measurement:
    """Measurement of poses [n, 4, 4] with information matrices [n, 6, 6] of their twists."""
    inverse = invert(Ts_measured)

    def linearise(Ts: np.ndarray) -> Linearised:
        E = inverse @ Ts
        left, J = twist(E), twist_jacobian(E)
        weighted = np.swapaxes(J, 1, 2) @ information
        gradient = (weighted @ left[..., None])[..., 0]
        return Linearised(weighted @ J, gradient)

    return linearise


def solve_bundle(
    Ts_world_tracker: np.ndarray,
    measurement: Measurement,
    tracker_sigma: tuple[float, float],
    start: tuple[np.ndarray, np.ndarray],
    *,
    is_mount_known: bool = False,
) -> Bundle:
    """Estimate mount and target pose from all views together.

    Args:
        Ts_world_tracker: [n, 4, 4].
        measurement: of the target's poses in the mounted frame.
        tracker_sigma: the tracker's noise, rad and m an axis; above zero.
        start: X and Z within a few degrees and centimetres.
        is_mount_known: leave X as it is.

    Raises:
        InvalidInputError: the steps do not become small.
    """
    X, Z = start
    free = slice(6, 12) if is_mount_known else slice(0, 12)
    tightness = np.repeat(np.square(1 / np.array(tracker_sigma)), 3)
    D = np.broadcast_to(np.eye(4), Ts_world_tracker.shape)
    for _ in range(MAX_ROUNDS):
        X_B = invert(Ts_world_tracker @ D) @ Z
        Ts = invert(X) @ X_B
        seen = measurement(Ts)
        J, C = predicted_jacobians(Ts, X_B)
        J_T, C_T = np.swapaxes(J, 1, 2), np.swapaxes(C, 1, 2)
        H_C = seen.information @ C
        J_D = twist_jacobian(D)
        pull = np.swapaxes(J_D, 1, 2) * tightness
        own = np.linalg.inv(C_T @ H_C + pull @ J_D)
        own_gradient = C_T @ seen.gradient[..., None] + pull @ twist(D)[..., None]
        # What is left for X and Z to explain once each view's correction has done its best.
        left = seen.information - H_C @ own @ np.swapaxes(H_C, 1, 2)
        gradient = J_T @ (seen.gradient[..., None] - H_C @ own @ own_gradient)
        normal = (J_T @ left @ J).sum(axis=0)[free, free]
        step = np.zeros(12)
        step[free] = -np.linalg.solve(normal, gradient.sum(axis=0)[free, 0])
        corrections = -own @ (own_gradient + np.swapaxes(H_C, 1, 2) @ (J @ step)[..., None])
        X, Z, D = X @ move(step[:6]), Z @ move(step[6:]), D @ move(corrections[..., 0])
        if max(np.abs(step).max(), np.abs(corrections).max()) < SMALLEST_STEP:
            covariance = np.zeros((12, 12))
            covariance[free, free] = np.linalg.inv(normal)
            return Bundle(X, Z, covariance)
    raise InvalidInputError(
        f"calibration: the bundle still moves by {np.abs(step).max():.1e} after {MAX_ROUNDS} "
        "rounds; the views are inconsistent; check that both series were taken at the same times"
    )


def predicted_jacobians(
    Ts: np.ndarray, X_B: np.ndarray
) -> tuple[Float64[np.ndarray, "n 6 12"], Float64[np.ndarray, "n 6 6"]]:
    """Jacobians of the predicted poses B = X⁻¹ D⁻¹ W⁻¹ Z by X, Z and D.

    `Ts` are the predicted poses B, `X_B` are X · B.
    """
    J = np.zeros((len(Ts), 6, 12))
    J[:, :, :6] = -adjoint(invert(Ts))
    J[:, :, 6:] = np.eye(6)
    return J, -adjoint(invert(X_B))
