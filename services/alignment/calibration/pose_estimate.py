"""Weighted estimate of a mount and a target from two series of poses, with its uncertainty.

Hand-eye and robot-base calibration are this estimate with another sensor in the second series: its
noise and the tracker's are estimated from the residuals, then the bundle adjustment is weighted
with them. The covariance of the bundle is that of the result.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import invert
from services.alignment.calibration.board_views import BoardViews
from services.alignment.calibration.bundle import (
    Bundle,
    pose_measurement,
    predicted_jacobians,
    solve_bundle,
)
from services.alignment.calibration.closed_form import Agreement, Series
from services.alignment.calibration.noise_components import (
    Component,
    estimate_sigmas,
    sensor_components,
)
from services.alignment.calibration.twists import twist

# A pose that is known worse than this is of no use (one sigma, three axes together).
MAX_SIGMA_ROTATION_RAD = np.deg2rad(0.5)
MAX_SIGMA_TRANSLATION_M = 0.01


@dataclass(frozen=True)
class TrackerNoise:
    """Expected noise of a tracker, one sigma for each axis; refined from the views."""

    task: ClassVar[str]
    tracker_rotation_rad: float = 8.7e-4
    tracker_translation_m: float = 5e-4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise InvalidInputError(
                    f"{self.task}: noise {name} is {value}, expected above zero"
                )


@dataclass(frozen=True)
class PoseEstimate:
    """How well views determine a pose.

    Attributes:
        covariance: [6, 6] of the pose's twist: turn (rad) and shift (m) along its own axes.
        noise: estimated noise (one sigma per axis), named as in the expected one.
        left_out_views: views that were far off and did not count.
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
    def doubt(self) -> str:
        """Sigmas beside their limits if the pose is too uncertain to be used; else empty."""
        sigma_rad, sigma_m = self.sigma_rotation_rad, self.sigma_translation_m
        if sigma_rad <= MAX_SIGMA_ROTATION_RAD and sigma_m <= MAX_SIGMA_TRANSLATION_M:
            return ""
        return (
            f"{np.rad2deg(sigma_rad):.2f} degrees and {sigma_m * 1e3:.1f} mm (one sigma), expected "
            f"at most {np.rad2deg(MAX_SIGMA_ROTATION_RAD):.1f} and "
            f"{MAX_SIGMA_TRANSLATION_M * 1e3:.0f}"
        )


def weighted_bundle(
    series: Series,
    agreed: Agreement,
    tracker: TrackerNoise,
    own: dict[str, Component],
    *,
    corners: BoardViews | None = None,
    is_mount_known: bool = False,
) -> tuple[Bundle, dict[str, float]]:
    """The bundle weighted with the noise estimated from the views, and that noise.

    The second series has the sources of noise `own`. With the corners of a board their pixels are
    weighted instead of its poses. A mount that is known stays as it is.
    """
    Ts = agreed.predicted(series)
    J, C = predicted_jacobians(Ts, agreed.X @ Ts)
    tracker_sigma = tracker.tracker_rotation_rad, tracker.tracker_translation_m
    components = sensor_components("tracker", C, tracker_sigma) | own
    left_over = twist(invert(series.Ts_mounted_target) @ Ts)
    unknowns = J[:, :, 6:] if is_mount_known else J
    found = estimate_sigmas(left_over, unknowns, list(components.values()))
    sigmas = dict(zip(components, found.tolist(), strict=True))
    if corners is None:
        shares = [sigmas[name] ** 2 * own[name].shapes for name in own]
        information = np.linalg.inv(np.sum(shares, axis=0))
        measurement = pose_measurement(series.Ts_mounted_target, information)
    else:
        measurement = corners.measurement(sigmas["pixel_px"])
    bundle = solve_bundle(
        series.Ts_world_body,
        measurement,
        (sigmas["tracker_rotation_rad"], sigmas["tracker_translation_m"]),
        (agreed.X, agreed.Z),
        is_mount_known=is_mount_known,
    )
    return bundle, sigmas
