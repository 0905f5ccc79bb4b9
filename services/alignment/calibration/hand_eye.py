"""Hand-eye calibration: where a camera sits on its tracker, with standard deviations.

A closed form provides the initial values, and degenerate motion is refused. Then the noise of
tracker and camera is estimated from the residuals, and a bundle adjustment weighted with it
estimates mount, board and the tracker error of every view. Its covariance is that of the result.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.geometry import invert
from dextouch.geometry.rotations import rotation_angle
from services.alignment.calibration.board_views import BoardViews, polish
from services.alignment.calibration.bundle import (
    Bundle,
    pose_measurement,
    predicted_jacobians,
    solve_bundle,
)
from services.alignment.calibration.closed_form import (
    Agreement,
    Series,
    agreeing_views,
    view_errors,
)
from services.alignment.calibration.motion import AXIS_NAMES, DegenerateMotionError, checked_poses
from services.alignment.calibration.noise_components import (
    Component,
    estimate_sigmas,
    sensor_components,
)
from services.alignment.calibration.twists import adjoint, twist

__all__ = ["DegenerateMotionError", "HandEyeNoise", "HandEyeResult", "mount_difference"]
__all__ += ["solve_hand_eye"]

TASK = "hand-eye"
# A mount that is known worse than this is of no use (one sigma, three axes together).
MAX_SIGMA_ROTATION_RAD = np.deg2rad(0.5)
MAX_SIGMA_TRANSLATION_M = 0.01


@dataclass(frozen=True)
class HandEyeNoise:
    """Expected noise, one sigma for each axis; refined from the views.

    The first three hold for a Vive tracker and a sharp board. `board_*` are of a board's pose that
    a solver found, in the camera's axes; they count only where no corners are given.
    """

    tracker_rotation_rad: float = 8.7e-4
    tracker_translation_m: float = 5e-4
    pixel_px: float = 0.3
    board_tilt_rad: float = 1.5e-3
    board_roll_rad: float = 5e-4
    board_sideways_m: float = 1.5e-4
    board_depth_m: float = 4e-4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise InvalidInputError(f"{TASK}: noise {name} is {value}, expected above zero")


@dataclass(frozen=True)
class HandEyeResult:
    """Where the camera sits on the tracker, and how well that is known (one sigma).

    Attributes:
        T_tracker_camera: the mount.
        sigma_rotation_rad: of the mount's rotation, length of the three axes' sigmas.
        sigma_translation_m: of its translation, likewise.
        covariance: [6, 6] of its twist: turn (rad) and shift (m) along the camera's own axes.
        T_world_board: where the board stood.
        rotation_rms_rad: how far the views turn the board from there.
        translation_rms_m: how far they put it from there.
        board_spread_m: mean distance of the board's places from their middle.
        noise: estimated noise (one sigma per axis), named as in `HandEyeNoise`.
        left_out_views: views that were far off and did not count.
    """

    T_tracker_camera: Float64[np.ndarray, "4 4"]
    sigma_rotation_rad: float
    sigma_translation_m: float
    covariance: Float64[np.ndarray, "6 6"]
    T_world_board: Float64[np.ndarray, "4 4"]
    rotation_rms_rad: float
    translation_rms_m: float
    board_spread_m: float
    noise: dict[str, float]
    left_out_views: tuple[int, ...]


def solve_hand_eye(
    Ts_world_tracker: np.ndarray,
    Ts_camera_board: np.ndarray,
    *,
    views: BoardViews | None = None,
    noise: HandEyeNoise | None = None,
) -> HandEyeResult:
    """Estimate the mount of a camera on a tracker from views of a fixed board.

    Args:
        Ts_world_tracker: [n ≥ 4, 4, 4] poses of the tracker in the world.
        Ts_camera_board: [n, 4, 4] poses of the board in the camera, same moments.
        views: the corners from which the board's poses were computed; with them each view is
            weighted by the information in its pixels, which is more accurate.
        noise: expected noise; default `HandEyeNoise()`.

    Raises:
        DegenerateMotionError: the tracker was rotated too little, or about one axis only, or the
            uncertainty of the mount exceeds half a degree or 10 mm.
        InvalidInputError: too few views, or views that contradict each other (an inverted series
            is named).
        ShapeError, NonFiniteError: no [n, 4, 4], or NaN.
    """
    tracker, board = checked_poses(
        TASK, Ts_world_tracker=Ts_world_tracker, Ts_camera_board=Ts_camera_board
    )
    if views is not None and len(views.points_board) != len(tracker):
        raise ShapeError(
            f"{TASK}: got {len(views.points_board)} views of corners and {len(tracker)} poses, "
            "expected corners of every pose"
        )
    names = ("Ts_world_tracker", "Ts_camera_board")
    series = Series(TASK, "tracker", tracker, board, names)
    agreed = agreeing_views(series)
    series = series.only(agreed.views)
    corners = None if views is None else views.only(agreed.views)
    bundle, sigmas = _weighted(series, agreed, corners, noise or HandEyeNoise())
    covariance = bundle.covariance[:6, :6]
    variances = np.diag(covariance)
    _, errors = view_errors(series, bundle.X)
    rms = np.sqrt(np.square(errors).mean(axis=0))
    result = HandEyeResult(
        T_tracker_camera=bundle.X,
        sigma_rotation_rad=float(np.sqrt(variances[:3].sum())),
        sigma_translation_m=float(np.sqrt(variances[3:].sum())),
        covariance=covariance,
        T_world_board=bundle.Z,
        rotation_rms_rad=float(rms[0]),
        translation_rms_m=float(rms[1]),
        board_spread_m=float(errors[:, 1].mean()),
        noise=sigmas,
        left_out_views=tuple(sorted(set(range(len(tracker))) - set(agreed.views.tolist()))),
    )
    _check_budget(result)
    return result


def _weighted(
    series: Series, agreed: Agreement, corners: BoardViews | None, noise: HandEyeNoise
) -> tuple[Bundle, dict[str, float]]:
    """The bundle weighted with the noise estimated from the views, and that noise."""
    tracker, board = series.Ts_world_body, series.Ts_mounted_target
    X_B = invert(tracker) @ agreed.Z
    Ts = invert(agreed.X) @ X_B
    J, C = predicted_jacobians(Ts, X_B)
    if corners is None:
        own = board_components(Ts, noise)
    else:
        one_pixel = corners.measurement(1.0)
        board = polish(one_pixel, board)
        shapes = np.linalg.inv(one_pixel(board).information)
        own = {"pixel_px": Component(noise.pixel_px, shapes)}
    components = sensor_components(
        "tracker", C, (noise.tracker_rotation_rad, noise.tracker_translation_m)
    )
    components |= own
    found = estimate_sigmas(twist(invert(board) @ Ts), J, list(components.values()))
    sigmas = dict(zip(components, (float(value) for value in found), strict=True))
    if corners is None:
        shares = [Component(sigmas[name], own[name].shapes).covariances for name in own]
        measurement = pose_measurement(board, np.linalg.inv(np.sum(shares, axis=0)))
    else:
        measurement = corners.measurement(sigmas["pixel_px"])
    tracker_sigma = sigmas["tracker_rotation_rad"], sigmas["tracker_translation_m"]
    return solve_bundle(tracker, measurement, tracker_sigma, (agreed.X, agreed.Z)), sigmas


def board_components(Ts_camera_board: np.ndarray, noise: HandEyeNoise) -> dict[str, Component]:
    """Noise of a board's pose: a camera sees tilt and depth worse than the rest."""
    R = Ts_camera_board[:, :3, :3]
    along = np.swapaxes(R, 1, 2)[:, :, 2:] @ R[:, 2:]
    across = np.eye(3) - along
    rows = (
        ("board_tilt_rad", noise.board_tilt_rad, across, slice(0, 3)),
        ("board_roll_rad", noise.board_roll_rad, along, slice(0, 3)),
        ("board_sideways_m", noise.board_sideways_m, across, slice(3, 6)),
        ("board_depth_m", noise.board_depth_m, along, slice(3, 6)),
    )
    components = {}
    for name, sigma, block, place in rows:
        shapes = np.zeros((len(R), 6, 6))
        shapes[:, place, place] = block
        components[name] = Component(sigma, shapes)
    return components


def _check_budget(result: HandEyeResult) -> None:
    """Refuse a mount whose standard deviation is too large."""
    if (
        result.sigma_rotation_rad <= MAX_SIGMA_ROTATION_RAD
        and result.sigma_translation_m <= MAX_SIGMA_TRANSLATION_M
    ):
        return
    # In the tracker's axes, as the operator turns the tracker.
    turned = adjoint(result.T_tracker_camera)
    covariance = turned @ result.covariance @ turned.T
    worst = np.linalg.eigh(covariance[:3, :3])[1][:, -1]
    axis = AXIS_NAMES[int(np.argmax(np.abs(worst)))]
    others = " and ".join(name for name in AXIS_NAMES if name != axis)
    raise DegenerateMotionError(
        f"{TASK}: the uncertainty of the mount is "
        f"{np.rad2deg(result.sigma_rotation_rad):.2f} degrees and "
        f"{result.sigma_translation_m * 1e3:.1f} mm (one sigma), expected at most "
        f"{np.rad2deg(MAX_SIGMA_ROTATION_RAD):.1f} and {MAX_SIGMA_TRANSLATION_M * 1e3:.0f}; the "
        f"rotation about the tracker's {axis} axis is least certain: rotate it more about "
        f"{others}, take more views, and move the board closer",
        missing_axes=[name for name in AXIS_NAMES if name != axis],
    )


def mount_difference(
    T_tracker_camera_a: np.ndarray, T_tracker_camera_b: np.ndarray
) -> tuple[float, float]:
    """Angle (rad) and distance (m) between two mounts."""
    T_a_b = invert(T_tracker_camera_a) @ T_tracker_camera_b
    return float(rotation_angle(T_a_b[:3, :3])), float(np.linalg.norm(T_a_b[:3, 3]))
