"""Hand-eye calibration: where a camera sits on its tracker, with standard deviations.

A closed form provides the initial values, and degenerate motion is refused. Then the noise of
tracker and camera is estimated from the residuals, and a bundle adjustment weighted with it
estimates mount, board and the tracker error of every view. Its covariance is that of the result.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import ShapeError
from services.alignment.calibration.board_views import BoardViews, polish
from services.alignment.calibration.closed_form import Series, agreeing_views
from services.alignment.calibration.motion import AXIS_NAMES, DegenerateMotionError, checked_poses
from services.alignment.calibration.noise_components import Component
from services.alignment.calibration.pose_estimate import (
    PoseEstimate,
    TrackerNoise,
    weighted_bundle,
)
from services.alignment.calibration.twists import adjoint

TASK = "hand-eye"


@dataclass(frozen=True)
class HandEyeNoise(TrackerNoise):
    """Expected noise, one sigma for each axis; refined from the views.

    That of the tracker and the pixels holds for a Vive tracker and a sharp board. `board_*` are of
    a board's pose that a solver found, in the camera's axes; they count only where no corners are
    given.
    """

    task = TASK
    pixel_px: float = 0.3
    board_tilt_rad: float = 1.5e-3
    board_roll_rad: float = 5e-4
    board_sideways_m: float = 1.5e-4
    board_depth_m: float = 4e-4


@dataclass(frozen=True)
class HandEyeResult(PoseEstimate):
    """Where the camera sits on the tracker, and how well that is known.

    Attributes:
        T_tracker_camera: the mount.
    """

    T_tracker_camera: Float64[np.ndarray, "4 4"]


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
    noise = noise or HandEyeNoise()
    names = ("Ts_world_tracker", "Ts_camera_board")
    series = Series(TASK, "tracker", tracker, board, names)
    agreed = agreeing_views(series)
    used = series.only(agreed.views)
    corners = None
    if views is None:
        own = board_components(agreed.predicted(used), noise)
    else:
        corners = views.only(agreed.views)
        one_pixel = corners.measurement(1.0)
        used = used._replace(Ts_mounted_target=polish(one_pixel, used.Ts_mounted_target))
        shapes = np.linalg.inv(one_pixel(used.Ts_mounted_target).information)
        own = {"pixel_px": Component(noise.pixel_px, shapes)}
    bundle, sigmas = weighted_bundle(used, agreed, noise, own, corners=corners)
    result = HandEyeResult(
        covariance=bundle.covariance[:6, :6],
        noise=sigmas,
        left_out_views=agreed.left_out(series),
        T_tracker_camera=bundle.X,
    )
    _check_budget(result)
    return result


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
    if not result.doubt:
        return
    # In the tracker's axes, as the operator turns the tracker.
    turned = adjoint(result.T_tracker_camera)
    covariance = turned @ result.covariance @ turned.T
    worst = np.linalg.eigh(covariance[:3, :3])[1][:, -1]
    axis = AXIS_NAMES[int(np.argmax(np.abs(worst)))]
    others = " and ".join(name for name in AXIS_NAMES if name != axis)
    raise DegenerateMotionError(
        f"{TASK}: the uncertainty of the mount is {result.doubt}; the "
        f"rotation about the tracker's {axis} axis is least certain: rotate it more about "
        f"{others}, take more views, and move the board closer",
        missing_axes=[name for name in AXIS_NAMES if name != axis],
    )
