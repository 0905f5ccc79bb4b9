"""Hand-eye methods under comparison: ours and OpenCV's."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from benchmarks.simulated.board_scenes import Scene
from dextouch.errors import DegenerateRotationError, InvalidInputError
from dextouch.geometry import invert, transform
from services.alignment.calibration.hand_eye import HandEyeNoise, solve_hand_eye
from services.alignment.calibration.motion import park

OURS = "ours"
OURS_POSES = "ours, poses only"
# Its rivals rely on the size of the board that was entered.
OURS_SIZE_KNOWN = "ours, size within 0.2 %"
PARK = "park"


@dataclass(frozen=True)
class Answer:
    """A mount, with the covariance of its twist where available."""

    T_tracker_camera: Float64[np.ndarray, "4 4"]
    covariance: Float64[np.ndarray, "6 6"] | None = None


class Method(NamedTuple):
    """A method that estimates the mount of a scene.

    `solve` raises InvalidInputError: the method refuses the scene, or returns no finite mount.
    """

    name: str
    solve: Callable[[Scene], Answer]


def _ours(scene: Scene, *, with_corners: bool, noise: HandEyeNoise | None = None) -> Answer:
    """Our weighted bundle adjustment, with the corners or with the board's poses alone."""
    views = scene.views if with_corners else None
    result = solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board, views=views, noise=noise)
    return Answer(result.T_tracker_camera, result.covariance)


def _opencv_hand_eye(scene: Scene, *, name: str) -> Answer:
    """`cv2.calibrateHandEye` with one of its methods."""
    tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
    return Answer(_opencv("calibrateHandEye", "CALIB_HAND_EYE", name, tracker, board))


def _opencv_robot_world(scene: Scene, *, name: str) -> Answer:
    """`cv2.calibrateRobotWorldHandEye` with one of its methods, which finds the board, too."""
    board, tracker = scene.Ts_camera_board, invert(scene.Ts_world_tracker)
    solver, prefix = "calibrateRobotWorldHandEye", "CALIB_ROBOT_WORLD_HAND_EYE"
    return Answer(invert(_opencv(solver, prefix, name, board, tracker)))


METHODS = (
    Method(OURS, partial(_ours, with_corners=True)),
    Method(OURS_POSES, partial(_ours, with_corners=False)),
    Method(
        OURS_SIZE_KNOWN, partial(_ours, with_corners=True, noise=HandEyeNoise(board_scale=2e-3))
    ),
    # The solution that initializes our bundle adjustment.
    Method(
        "our closed form",
        lambda scene: Answer(park(scene.Ts_world_tracker, scene.Ts_camera_board)),
    ),
    *(
        Method(name, partial(_opencv_hand_eye, name=name))
        for name in ("tsai", PARK, "horaud", "andreff", "daniilidis")
    ),
    *(Method(name, partial(_opencv_robot_world, name=name)) for name in ("shah", "li")),
)


def _opencv(
    solver: str, prefix: str, name: str, first: np.ndarray, second: np.ndarray
) -> Float64[np.ndarray, "4 4"]:
    """The last transform that a solver of OpenCV gives for two series of poses."""
    import cv2

    # Failures are in the table.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    poses = [list(part) for Ts in (first, second) for part in (Ts[:, :3, :3], Ts[:, :3, 3])]
    try:
        # By keyword: the fifth positional argument is an output, not the method.
        *_, R, t = getattr(cv2, solver)(*poses, method=getattr(cv2, f"{prefix}_{name.upper()}"))
    except cv2.error as error:
        raise InvalidInputError(f"{name}: OpenCV gives up ({error})") from error
    T = transform(np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel())
    if not np.isfinite(T).all():
        raise DegenerateRotationError(f"{name}: OpenCV returns NaN without an error")
    return T
