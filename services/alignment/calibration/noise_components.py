"""Variance component estimation: how large each source of noise in a calibration is.

Each source k has a known shape and an unknown variance: the twist left over in view i has the
covariance Σ_k θ_k M_ki. The θ that fit best are found by Fisher scoring of the restricted
likelihood (Patterson and Thompson 1971: it counts the unknowns that were fitted to the same
views), with a log-normal prior about the sizes that were declared, as few views say little.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

MAX_ROUNDS = 25
MAX_STEP = 1.0
SMALLEST_STEP = 1e-3
# The declared noise is trusted to a factor of four (one sigma): exp(1.4).
PRIOR_LOG_SIGMA = 1.4
# Lower bound of a variance, as a share of the declared one.
MIN_SHARE = 1e-6


@dataclass(frozen=True)
class Component:
    """One source of noise: declared standard deviation, and its covariance [n, 6, 6] at one."""

    sigma: float
    shapes: Float64[np.ndarray, "n 6 6"]


def sensor_components(
    sensor: str, maps: np.ndarray, sigmas: tuple[float, float]
) -> dict[str, Component]:
    """Rotation and translation noise of a pose sensor, in its own axes.

    Args:
        sensor: for the names of the two components.
        maps: [n, 6, 6] take its twists to those of the views.
        sigmas: declared, rad and m an axis.
    """
    maps_T = np.swapaxes(maps, 1, 2)
    turns, shifts = maps[:, :, :3] @ maps_T[:, :3], maps[:, :, 3:] @ maps_T[:, 3:]
    return {
        f"{sensor}_rotation_rad": Component(sigmas[0], turns),
        f"{sensor}_translation_m": Component(sigmas[1], shifts),
    }


def estimate_sigmas(
    left_over: np.ndarray, J: np.ndarray, components: list[Component]
) -> Float64[np.ndarray, " k"]:
    """Standard deviation of each component.

    Args:
        left_over: [n, 6] twists of views that are not explained, before the last linear step.
        J: [n, 6, m] how they change with the m unknowns that are fitted.
        components: the sources.
    """
    M = np.stack([component.shapes for component in components])
    declared = np.log(np.square([component.sigma for component in components]))
    log_theta = declared.copy()
    for _ in range(MAX_ROUNDS):
        step = _scoring_step(left_over, J, M, (log_theta, declared))
        log_theta = log_theta + np.clip(step, -MAX_STEP, MAX_STEP)
        log_theta = np.maximum(log_theta, declared + 2 * np.log(MIN_SHARE))
        if np.abs(step).max() < SMALLEST_STEP:
            break
    return np.exp(0.5 * log_theta)


def _scoring_step(
    left_over: np.ndarray, J: np.ndarray, M: np.ndarray, logs: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """One step of the logarithms of the variances; `logs` are where they are and were declared."""
    log_theta, declared = logs
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
    return np.linalg.solve(fisher, gradient)
