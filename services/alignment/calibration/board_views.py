"""Reprojection model of a calibration board seen by a calibrated camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from services.alignment.calibration.bundle import Linearised, Measurement
from services.alignment.calibration.twists import adjoint, move

MIN_CORNERS = 4
# Poses of a board come from a solver; few steps bring them to the minimum of the pixels.
POLISH_ROUNDS = 5


@dataclass(frozen=True)
class BoardViews:
    """Detected corners of a board in several views, and the camera's intrinsics.

    Attributes:
        points_board: a view each, [k ≥ 4, 3] corners in board coordinates (m).
        pixels_px: a view each, [k, 2] where they were seen.
        K: the camera's matrix.
        distortion: k1 k2 p1 p2 k3.
    """

    points_board: Sequence[np.ndarray]
    pixels_px: Sequence[np.ndarray]
    K: Float64[np.ndarray, "3 3"]
    distortion: Float64[np.ndarray, "5"]

    def __post_init__(self) -> None:
        if len(self.points_board) != len(self.pixels_px) or not self.points_board:
            raise ShapeError(
                f"board views: got {len(self.points_board)} and {len(self.pixels_px)} views, "
                "expected the same number of both, at least one"
            )
        for index, (points, pixels) in enumerate(
            zip(self.points_board, self.pixels_px, strict=True)
        ):
            if points.shape != (len(points), 3) or pixels.shape != (len(points), 2):
                raise ShapeError(
                    f"board view {index}: got {points.shape} and {pixels.shape}, expected [k, 3] "
                    "corners in metres and their [k, 2] pixels"
                )
            if len(points) < MIN_CORNERS:
                raise InvalidInputError(
                    f"board view {index}: got {len(points)} corners, expected at least "
                    f"{MIN_CORNERS}; leave the view out"
                )
            if not (np.isfinite(points).all() and np.isfinite(pixels).all()):
                raise NonFiniteError(f"board view {index}: NaN or infinity among the corners")

    def only(self, views: np.ndarray) -> "BoardViews":
        """A subset of the views."""
        return BoardViews(
            [self.points_board[index] for index in views],
            [self.pixels_px[index] for index in views],
            self.K,
            self.distortion,
        )

    def measurement(self, sigma_px: float) -> Measurement:
        """Reprojection errors with their analytic Jacobian, for pixels of this noise an axis."""
        most = max(len(points) for points in self.points_board)
        points = np.ones((len(self.points_board), most, 3))
        pixels = np.zeros((len(points), most, 2))
        weights = np.zeros((len(points), most, 1))
        for index, corners in enumerate(self.points_board):
            points[index] = corners[0]
            points[index, : len(corners)] = corners
            pixels[index, : len(corners)] = self.pixels_px[index]
            weights[index, : len(corners)] = 1 / sigma_px

        def linearise(Ts_camera_board: np.ndarray) -> Linearised:
            projected, J = project(points, Ts_camera_board, self.K, self.distortion)
            left = ((projected - pixels) * weights).reshape(len(points), -1, 1)
            J = (J * weights[..., None]).reshape(len(points), -1, 6)
            J_T = np.swapaxes(J, 1, 2)
            return Linearised(J_T @ J, (J_T @ left)[..., 0])

        return linearise


def project(
    points_board: np.ndarray, Ts_camera_board: np.ndarray, K: np.ndarray, distortion: np.ndarray
) -> tuple[Float64[np.ndarray, "n k 2"], Float64[np.ndarray, "n k 2 6"]]:
    """Project corners [n, k, 3], with the Jacobian by twists of the board's poses.

    Raises:
        InvalidInputError: a corner lies behind the camera.
    """
    import cv2

    points = points_board @ np.swapaxes(Ts_camera_board[:, :3, :3], 1, 2)
    points = points + Ts_camera_board[:, None, :3, 3]
    if (points[..., 2] <= 0).any():
        raise InvalidInputError(
            "board views: a corner lies behind the camera; the board's pose or its corners are "
            "wrong, check which side is inverted"
        )
    still = np.zeros(3)
    pixels, J = cv2.projectPoints(points.reshape(-1, 3), still, still, K, distortion)
    shape = (*points.shape[:2], 2)
    # By twists of the camera's frame, where the corners already are.
    J_camera = np.asarray(J)[:, :6].reshape(*shape, 6)
    return np.asarray(pixels).reshape(shape), J_camera @ adjoint(Ts_camera_board)[:, None]


def polish(measurement: Measurement, Ts_camera_board: np.ndarray) -> Float64[np.ndarray, "n 4 4"]:
    """Refine each view's pose to the least reprojection error."""
    Ts = Ts_camera_board
    for _ in range(POLISH_ROUNDS):
        seen = measurement(Ts)
        Ts = Ts @ move(-np.linalg.solve(seen.information, seen.gradient[..., None])[..., 0])
    return Ts
