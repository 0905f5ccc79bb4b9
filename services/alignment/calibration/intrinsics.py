"""Camera intrinsics and distortion from photos of a flat board, with standard deviations."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.board_detection import FoundBoards
from services.alignment.calibration.motion import DegenerateMotionError

MIN_VIEWS = 5
# Views from one direction alone cannot tell focal length from distance.
MIN_TILT_SPREAD_RAD = np.deg2rad(15.0)
MAX_FOCAL_SIGMA = 0.05


@dataclass(frozen=True)
class CameraCalibration:
    """A pinhole camera with distortion k1 k2 p1 p2 k3.

    Attributes:
        K: the camera's matrix (px).
        distortion: k1 k2 p1 p2 k3.
        sigma_fxfycxcy_px: standard deviations of fx fy cx cy; they show how good the calibration
            is. `rms_px` does not: it is as small for 8 views as for 40.
        sigma_distortion: of the distortion.
        rms_px: of the residuals between corners and model, both axes together.
        rms_by_photo_px: the same by photo; a much larger one means that the photo is blurred or the
            board was bent.
        coverage: share of a 4 × 4 grid over the image in which corners were seen.
        used_images: indices of the photos on which the board was found.
    """

    K: Float64[np.ndarray, "3 3"]
    distortion: Float64[np.ndarray, "5"]
    sigma_fxfycxcy_px: Float64[np.ndarray, "4"]
    sigma_distortion: Float64[np.ndarray, "5"]
    rms_px: float
    rms_by_photo_px: Float64[np.ndarray, " n"]
    coverage: float
    used_images: tuple[int, ...]


def calibrate_found(found: FoundBoards) -> CameraCalibration:
    """Intrinsics from photos of one board in different tilts and places.

    Raises:
        InvalidInputError: the board is found in too few photos.
        DegenerateMotionError: the views do not show the focal length; tilt the board.
    """
    import cv2

    if len(found.photos) < MIN_VIEWS:
        raise InvalidInputError(
            f"photos: the board is found in {len(found.photos)} of {found.num_photos}, expected at "
            f"least {MIN_VIEWS}; check the board's size and kind, light and sharpness"
        )
    rms_px, K, distortion, turns, _, sigma, _, by_photo = cv2.calibrateCameraExtended(
        list(found.points_board),
        list(found.pixels_px),
        found.image_size_px,
        np.eye(3),
        np.zeros(5),
    )
    sigma = np.asarray(sigma, dtype=np.float64).ravel()
    K = np.asarray(K, dtype=np.float64)
    _check_views(
        rotation_from_vector(np.array(turns, dtype=np.float64).reshape(-1, 3)),
        float(max(sigma[0] / K[0, 0], sigma[1] / K[1, 1])),
    )
    return CameraCalibration(
        K=K,
        distortion=np.asarray(distortion, dtype=np.float64).ravel()[:5],
        sigma_fxfycxcy_px=sigma[:4],
        sigma_distortion=sigma[4:9],
        rms_px=float(rms_px),
        rms_by_photo_px=np.asarray(by_photo, dtype=np.float64).ravel(),
        coverage=_coverage(found.pixels_px, found.image_size_px),
        used_images=found.photos,
    )


def _coverage(pixels_px: Sequence[np.ndarray], image_size_px: tuple[int, int]) -> float:
    cells = np.concatenate(list(pixels_px)) / np.array(image_size_px) * 4
    return len(np.unique(cells.astype(int).clip(0, 3), axis=0)) / 16


def _check_views(Rs_camera_board: np.ndarray, relative: float) -> None:
    """Refuse views that do not determine the focal length, known to a `relative` sigma."""
    normals = Rs_camera_board[:, :, 2]
    # Largest angle between two directions of the board.
    spread_rad = float(np.arccos(np.clip(normals @ normals.T, -1, 1)).max())
    if spread_rad < MIN_TILT_SPREAD_RAD or not relative <= MAX_FOCAL_SIGMA:
        raise DegenerateMotionError(
            f"intrinsics: the board's directions differ by {np.rad2deg(spread_rad):.0f} degrees "
            f"at most and the focal length is known to {relative:.1%}; expected at least "
            f"{np.rad2deg(MIN_TILT_SPREAD_RAD):.0f} degrees and {MAX_FOCAL_SIGMA:.0%}: take photos "
            "with the board tilted by 20 to 45 degrees about both its axes",
            spread_deg=float(np.rad2deg(spread_rad)),
            relative_sigma=relative,
        )
