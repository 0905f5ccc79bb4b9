"""Weighted estimate of a mount and a target from two series of poses, with its uncertainty.

Every view says T_world_tracker · D · X · B = Z, with the mount X, the target's pose Z, the measured
pose B of the target in the mounted frame, and a small correction D of the tracker's pose. Sources
of noise are estimated from the residuals, then all poses by Gauss–Newton. The Schur complement
eliminates the corrections; the last of 13 unknowns is the scale of the second series: an error of
the board's size would otherwise move the mount without a trace in its covariance.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import invert, transform
from services.alignment.calibration.motion import (
    Agreement,
    adjoint,
    excess_over_time,
    move,
    twist,
    twist_jacobian,
)

# Of the Gauss–Newton steps; below the smallest (rad, m) nothing changes that could be measured.
MAX_ROUNDS = 30
SMALLEST_STEP = 1e-10
# Of the estimate of noise, in logarithms of variances.
MAX_NOISE_ROUNDS = 25
MAX_NOISE_STEP = 1.0
SMALLEST_NOISE_STEP = 1e-3
# The declared noise is trusted to a factor of four (one sigma): exp(1.4).
PRIOR_LOG_SIGMA = 1.4
# Lower bound of a variance, as a share of the declared one.
MIN_SHARE = 1e-6
# Of the expected variance of the scale, below which the views alone determine it.
MAX_SCALE_SHARE = 0.1
# A pose that is known worse than this is of no use (one sigma, three axes together).
MAX_SIGMA_ROTATION_RAD = np.deg2rad(0.5)
MAX_SIGMA_TRANSLATION_M = 0.01


class Linearised(NamedTuple):
    """Normal equations of half the weighted squares of a measurement, at predicted poses."""

    information: Float64[np.ndarray, "n 6 6"]
    gradient: Float64[np.ndarray, "n 6"]


Measurement = Callable[[np.ndarray], Linearised]


@dataclass(frozen=True)
class TrackerNoise:
    """Expected noise of a tracker, one sigma for each axis; refined from the views."""

    tracker_rotation_rad: float = 8.7e-4
    tracker_translation_m: float = 5e-4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise InvalidInputError(f"expected noise {name}: got {value}, expected above zero")


@dataclass(frozen=True)
class PoseEstimate:
    """How well views determine a pose.

    `covariance` is of its twist: turn (rad) and shift (m) along its own axes; `noise` the estimated
    one (one sigma an axis), named as the expected one; `left_out_views` were too far off to count.
    """

    covariance: Float64[np.ndarray, "6 6"]
    noise: dict[str, float]
    left_out_views: tuple[int, ...]

    @property
    def sigma_rotation_rad(self) -> float:
        """One sigma of the rotation, length of the three axes' sigmas."""
        return float(np.sqrt(np.diag(self.covariance)[:3].sum()))

    @property
    def sigma_translation_m(self) -> float:
        """One sigma of the translation, likewise."""
        return float(np.sqrt(np.diag(self.covariance)[3:].sum()))

    @property
    def excessive_sigma(self) -> str:
        """Sigmas beside their limits if the pose is too uncertain to be used; else empty."""
        sigma_rad, sigma_m = self.sigma_rotation_rad, self.sigma_translation_m
        if sigma_rad <= MAX_SIGMA_ROTATION_RAD and sigma_m <= MAX_SIGMA_TRANSLATION_M:
            return ""
        return (
            f"{np.rad2deg(sigma_rad):.2f} degrees and {sigma_m * 1e3:.1f} mm (one sigma), expected "
            f"at most {np.rad2deg(MAX_SIGMA_ROTATION_RAD):.1f} and "
            f"{MAX_SIGMA_TRANSLATION_M * 1e3:.0f}"
        )


@dataclass(frozen=True)
class Component:
    """One source of noise: declared standard deviation, and its covariance [n, 6, 6] at one."""

    sigma: float
    shapes: Float64[np.ndarray, "n 6 6"]


@dataclass(frozen=True)
class Bundle:
    """The mount X, the target's pose Z in the world, the scale, and how well they are known.

    `scale` is true over measured lengths of the second series. The covariance is of the twists of
    X, then of Z (rad, m, in their own frames), then of log scale; zero for what was given. It is
    `excess` times that of independent errors.
    """

    X: Float64[np.ndarray, "4 4"]
    Z: Float64[np.ndarray, "4 4"]
    scale: float
    covariance: Float64[np.ndarray, "13 13"]
    excess: float = 1.0


def weighted_bundle(
    agreed: Agreement,
    tracker: TrackerNoise,
    own: dict[str, Component],
    *,
    scale_sigma: float = 0.0,
) -> tuple[Bundle, dict[str, float]]:
    """The bundle weighted with the noise estimated from the views, and that noise.

    The second series has the noise `own`, and a scale of one within `scale_sigma`. The covariance
    holds for errors as large as changes from place to place. Raises InvalidInputError: mount,
    target or clock changed along the views, or the steps do not become small.
    """
    series, Ts = agreed.series, agreed.predicted
    J, C = predicted_jacobians(Ts, agreed.X @ Ts, 1.0)
    declared = tracker.tracker_rotation_rad, tracker.tracker_translation_m
    components = sensor_components("tracker", C, declared) | own
    left_over = twist(invert(series.Ts_mounted_target) @ Ts)
    free = free_unknowns(is_mount_known=agreed.is_mount_known, is_scale_known=scale_sigma == 0)
    found = estimate_sigmas(left_over, J[:, :, free], list(components.values()))
    sigmas = dict(zip(components, found.tolist(), strict=True))
    shares = [sigmas[name] ** 2 * own[name].shapes for name in own]
    bundle = solve_bundle(
        series.Ts_world_body,
        pose_measurement(series.Ts_mounted_target, np.linalg.inv(np.sum(shares, axis=0))),
        (sigmas["tracker_rotation_rad"], sigmas["tracker_translation_m"]),
        (agreed.X, agreed.Z),
        is_mount_known=agreed.is_mount_known,
        scale_sigma=scale_sigma,
    )
    all_shares = [sigmas[name] ** 2 * component.shapes for name, component in components.items()]
    whiten = np.linalg.inv(np.linalg.cholesky(np.sum(all_shares, axis=0)))
    Ts = agreed._replace(X=bundle.X, Z=bundle.Z).predicted
    J, C = predicted_jacobians(Ts, bundle.X @ Ts, bundle.scale)
    Ts[:, :3, 3] /= bundle.scale
    left_over = (whiten @ twist(invert(series.Ts_mounted_target) @ Ts)[..., None])[..., 0]
    if bundle.covariance[12, 12] < MAX_SCALE_SHARE * scale_sigma**2:
        # What was expected leaves nothing of it in the residuals.
        free = free[free < 12]
    excess = excess_over_time(series, left_over, whiten @ J, whiten @ C, free, declared)
    return replace(bundle, covariance=excess * bundle.covariance, excess=excess), sigmas


def sensor_components(
    sensor: str, maps: np.ndarray, sigmas: tuple[float, float]
) -> dict[str, Component]:
    """Rotation (rad) and translation (m) noise of a sensor's twists; `maps` take them to views'."""
    maps_T = np.swapaxes(maps, 1, 2)
    turns, shifts = maps[:, :, :3] @ maps_T[:, :3], maps[:, :, 3:] @ maps_T[:, 3:]
    return {
        f"{sensor}_rotation_rad": Component(sigmas[0], turns),
        f"{sensor}_translation_m": Component(sigmas[1], shifts),
    }


def estimate_sigmas(
    left_over: np.ndarray, J: np.ndarray, components: list[Component]
) -> Float64[np.ndarray, " k"]:
    """Standard deviation of each component (variance component estimation).

    The residual twist of view i [n, 6], which changes with the m fitted unknowns by J [n, 6, m],
    has the covariance Σ_k θ_k M_ki. Fisher scoring of the restricted likelihood finds the best θ
    (Patterson and Thompson 1971), with a log-normal prior about the declared sizes.
    """
    M = np.stack([component.shapes for component in components])
    declared = np.log(np.square([component.sigma for component in components]))
    log_theta = declared.copy()
    for _ in range(MAX_NOISE_ROUNDS):
        scaled = M * np.exp(log_theta)[:, None, None, None]
        inverse = np.linalg.inv(scaled.sum(axis=0))
        weighted_J = inverse @ J
        fitted = np.linalg.inv((np.swapaxes(J, 1, 2) @ weighted_J).sum(axis=0))
        unknowns = fitted @ (np.swapaxes(weighted_J, 1, 2) @ left_over[..., None]).sum(axis=0)
        residual = inverse @ (left_over[..., None] - J @ unknowns)
        squares = (np.swapaxes(residual, 1, 2) @ scaled @ residual).sum(axis=(1, 2, 3))
        shares = inverse @ scaled
        expected = np.trace(shares, axis1=2, axis2=3).sum(axis=1)
        used_up = (np.swapaxes(weighted_J, 1, 2) @ scaled @ weighted_J).sum(axis=1)
        expected -= (used_up * fitted.T).sum(axis=(1, 2))
        gradient = 0.5 * (squares - expected) - (log_theta - declared) / PRIOR_LOG_SIGMA**2
        flat = shares.reshape(len(M), -1)
        turned = np.swapaxes(shares, 2, 3).reshape(len(M), -1)
        fisher = 0.5 * flat @ turned.T + np.eye(len(M)) / PRIOR_LOG_SIGMA**2
        step = np.linalg.solve(fisher, gradient)
        log_theta = log_theta + np.clip(step, -MAX_NOISE_STEP, MAX_NOISE_STEP)
        log_theta = np.maximum(log_theta, declared + 2 * np.log(MIN_SHARE))
        if np.abs(step).max() < SMALLEST_NOISE_STEP:
            break
    return np.exp(0.5 * log_theta)


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
    scale_sigma: float = 0.0,
) -> Bundle:
    """Estimate mount, target pose and scale from all views together.

    `measurement` is of the target's poses in the mounted frame, the tracker's noise in rad and m an
    axis; `start` are X (which stays if `is_mount_known`) and Z within a few degrees and
    centimetres; `scale_sigma` is the expected deviation of the scale from one, 0 leaves it at one.
    Raises InvalidInputError: the steps do not become small.
    """
    X, Z = start
    free = free_unknowns(is_mount_known=is_mount_known, is_scale_known=scale_sigma == 0)
    expected = np.zeros((13, 13))
    expected[12, 12] = 1 / scale_sigma**2 if scale_sigma else 0.0
    log_scale = 0.0
    tightness = np.repeat(np.square(1 / np.array(tracker_sigma)), 3)
    D = np.broadcast_to(np.eye(4), Ts_world_tracker.shape)
    for _ in range(MAX_ROUNDS):
        X_B = invert(Ts_world_tracker @ D) @ Z
        Ts = invert(X) @ X_B
        scale = float(np.exp(log_scale))
        seen = measurement(transform(Ts[:, :3, :3], Ts[:, :3, 3] / scale))
        J, C = predicted_jacobians(Ts, X_B, scale)
        J_T, C_T = np.swapaxes(J, 1, 2), np.swapaxes(C, 1, 2)
        H_C = seen.information @ C
        J_D = twist_jacobian(D)
        pull = np.swapaxes(J_D, 1, 2) * tightness
        own = np.linalg.inv(C_T @ H_C + pull @ J_D)
        own_gradient = C_T @ seen.gradient[..., None] + pull @ twist(D)[..., None]
        # What is left for X and Z to explain once each view's correction has done its best.
        left = seen.information - H_C @ own @ np.swapaxes(H_C, 1, 2)
        gradients = J_T @ (seen.gradient[..., None] - H_C @ own @ own_gradient)
        gradient = gradients.sum(axis=0)[:, 0] + expected[:, 12] * log_scale
        normal = ((J_T @ left @ J).sum(axis=0) + expected)[np.ix_(free, free)]
        step = np.zeros(13)
        step[free] = -np.linalg.solve(normal, gradient[free])
        corrections = -own @ (own_gradient + np.swapaxes(H_C, 1, 2) @ (J @ step)[..., None])
        X, Z, D = X @ move(step[:6]), Z @ move(step[6:12]), D @ move(corrections[..., 0])
        log_scale += step[12]
        if max(np.abs(step).max(), np.abs(corrections).max()) < SMALLEST_STEP:
            covariance = np.zeros((13, 13))
            covariance[np.ix_(free, free)] = np.linalg.inv(normal)
            return Bundle(X, Z, float(np.exp(log_scale)), covariance)
    raise InvalidInputError(
        f"calibration: the bundle still moves by {np.abs(step).max():.1e} after {MAX_ROUNDS} "
        "rounds; the views are inconsistent; check that both series were taken at the same times"
    )


def free_unknowns(*, is_mount_known: bool, is_scale_known: bool) -> np.ndarray:
    """Indices of the unknowns that are estimated: 0 … 5 the mount, 6 … 11 the target, 12 scale."""
    return np.arange(6 if is_mount_known else 0, 12 if is_scale_known else 13)


def predicted_jacobians(
    Ts: np.ndarray, X_B: np.ndarray, scale: float
) -> tuple[Float64[np.ndarray, "n 6 13"], Float64[np.ndarray, "n 6 6"]]:
    """Jacobians of predicted poses `Ts` (`X_B` = X · Ts) by X, Z and log scale, and by D."""
    J = np.zeros((len(Ts), 6, 13))
    J[:, :, :6] = -adjoint(invert(Ts))
    J[:, :, 6:12] = np.eye(6)
    C = -adjoint(invert(X_B))
    J[:, 3:] /= scale
    C[:, 3:] /= scale
    J[:, 3:, 12] = -np.einsum("nji,nj->ni", Ts[:, :3, :3], Ts[:, :3, 3]) / scale
    return J, C
