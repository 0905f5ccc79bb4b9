"""Hand-eye methods under comparison: ours and OpenCV's."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from dextouch.errors import DegenerateRotationError, InvalidInputError
from dextouch.geometry import invert, transform
from services.alignment.calibration.hand_eye import HandEyeNoise, HandEyeResult, solve_hand_eye
from services.alignment.calibration.motion import park

if TYPE_CHECKING:
    from benchmarks.simulated.board_scenes import Scene

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


class Method(ABC):
    """A method that estimates the mount."""

    name: str

    @abstractmethod
    def solve(self, scene: "Scene") -> Answer:
        """Estimate the mount.

        Raises:
            InvalidInputError: the method refuses the scene, or returns no finite mount.
        """


class Ours(Method):
    """Our weighted bundle adjustment, with the corners or with the board's poses alone."""

    def __init__(self, name: str, *, with_corners: bool, noise: HandEyeNoise | None = None) -> None:
        self.name = name
        self._with_corners, self._noise = with_corners, noise

    def solve(self, scene: "Scene") -> Answer:
        """By `solve_hand_eye`."""
        views = scene.views if self._with_corners else None
        result: HandEyeResult = solve_hand_eye(
            scene.Ts_world_tracker, scene.Ts_camera_board, views=views, noise=self._noise
        )
        return Answer(result.T_tracker_camera, result.covariance)


class OurPark(Method):
    """The closed-form solution that initializes our bundle adjustment."""

    name = "our closed form"

    def solve(self, scene: "Scene") -> Answer:
        """By the closed form alone."""
        return Answer(park(scene.Ts_world_tracker, scene.Ts_camera_board))


class OpenCvHandEye(Method):
    """`cv2.calibrateHandEye` with one of its methods."""

    def __init__(self, name: str) -> None:
        self.name = name

    def solve(self, scene: "Scene") -> Answer:
        """By OpenCV."""
        cv2 = _quiet_opencv()
        tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
        try:
            # By keyword: the fifth positional argument is an output, not the method.
            R, t = cv2.calibrateHandEye(
                list(tracker[:, :3, :3]),
                list(tracker[:, :3, 3]),
                list(board[:, :3, :3]),
                list(board[:, :3, 3]),
                method=getattr(cv2, f"CALIB_HAND_EYE_{self.name.upper()}"),
            )
        except cv2.error as error:
            raise InvalidInputError(f"{self.name}: OpenCV gives up ({error})") from error
        return Answer(_finite(self.name, R, t))


class OpenCvRobotWorld(Method):
    """`cv2.calibrateRobotWorldHandEye` with one of its methods."""

    def __init__(self, name: str) -> None:
        self.name = name

    def solve(self, scene: "Scene") -> Answer:
        """By OpenCV, which finds the board's place too."""
        cv2 = _quiet_opencv()

        board, tracker = scene.Ts_camera_board, invert(scene.Ts_world_tracker)
        try:
            _, _, R, t = cv2.calibrateRobotWorldHandEye(
                list(board[:, :3, :3]),
                list(board[:, :3, 3]),
                list(tracker[:, :3, :3]),
                list(tracker[:, :3, 3]),
                method=getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{self.name.upper()}"),
            )
        except cv2.error as error:
            raise InvalidInputError(f"{self.name}: OpenCV gives up ({error})") from error
        return Answer(invert(_finite(self.name, R, t)))


METHODS: tuple[Method, ...] = (
    Ours(OURS, with_corners=True),
    Ours(OURS_POSES, with_corners=False),
    Ours(OURS_SIZE_KNOWN, with_corners=True, noise=HandEyeNoise(board_scale=2e-3)),
    OurPark(),
    *(OpenCvHandEye(name) for name in ("tsai", PARK, "horaud", "andreff", "daniilidis")),
    *(OpenCvRobotWorld(name) for name in ("shah", "li")),
)


def _quiet_opencv() -> ModuleType:
    """OpenCV with its error output suppressed, since failures are in the table."""
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2


def _finite(name: str, R: object, t: object) -> Float64[np.ndarray, "4 4"]:
    T = transform(np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel())
    if not np.isfinite(T).all():
        raise DegenerateRotationError(f"{name}: OpenCV returns NaN without an error")
    return T
