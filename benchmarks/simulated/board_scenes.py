"""Simulated hand-eye scenes: noisy views of a board with a known mount."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from dextouch.errors import LimitExceededError
from dextouch.geometry import invert, transform
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector
from services.alignment.calibration.hand_eye import BoardViews, project
from services.alignment.calibration.intrinsics import CHESSBOARD, FoundBoards
from services.alignment.calibration.motion import move

IMAGE_SIZE_PX = (1280, 720)
K = np.array([[910.0, 0.0, 640.0], [0.0, 905.0, 360.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([0.05, -0.1, 0.001, -0.0005, 0.02])
COLUMNS, ROWS, SQUARE_M = 9, 6, 0.03
MARGIN_PX = 5.0
MAX_TRIES = 100_000
# Large enough for boards to reach the edges of the image.
SIDEWAYS_M = 0.25
TURN_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Motion:
    """Motion of a camera in front of a board, and noise levels.

    Attributes:
        num_views: number of views with the whole board in the image.
        tilt_deg: rotations about each axis are uniform within ± this.
        axes: share of `tilt_deg` by axis of the camera; zero disables an axis.
        distance_m: minimum and maximum.
        sideways_m: the board's centre lies within ± this of the optical axis.
        pixel_px: noise of corners per axis.
        tracker_rotation_deg: noise of the tracker per axis.
        tracker_translation_m: likewise.
    """

    num_views: int = 20
    tilt_deg: float = 35.0
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0)
    distance_m: tuple[float, float] = (0.4, 0.7)
    sideways_m: float = 0.08
    pixel_px: float = 0.3
    tracker_rotation_deg: float = 0.05
    tracker_translation_m: float = 5e-4


@dataclass(frozen=True)
class Scene:
    """Simulated measurements with ground truth: the true mount, and the true pose of the board.

    The tracker's poses and the corners are noisy; `Ts_camera_board` fit the noisy corners best.
    """

    Ts_world_tracker: Float64[np.ndarray, "n 4 4"]
    views: BoardViews
    Ts_camera_board: Float64[np.ndarray, "n 4 4"]
    T_tracker_camera: Float64[np.ndarray, "4 4"]
    T_world_board: Float64[np.ndarray, "4 4"]

    def repeated(self, views: list[int]) -> "Scene":
        """A scene of selected views, which may repeat."""
        index = np.array(views)
        return replace(
            self,
            Ts_world_tracker=self.Ts_world_tracker[index],
            Ts_camera_board=self.Ts_camera_board[index],
            views=self.views.only(index),
        )


def board_points() -> Float64[np.ndarray, "k 3"]:
    """Inner corners of the board, row by row, the first at the origin."""
    columns, rows = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    return np.column_stack([columns.ravel(), rows.ravel(), 0 * rows.ravel()]) * SQUARE_M


def make_scene(seed: int, motion: Motion | None = None) -> Scene:
    """Simulate views of a board by a moving camera.

    Raises LimitExceededError if the board is rarely inside the image.
    """
    motion = motion or Motion()
    rng = np.random.default_rng(seed)
    X = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(scale=0.05, size=3))
    Z = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(scale=0.5, size=3))
    Ts_camera_board, pixels = _seen_boards(rng, motion)
    noise = rng.normal(size=(motion.num_views, 6))
    noise[:, :3] *= np.deg2rad(motion.tracker_rotation_deg)
    noise[:, 3:] *= motion.tracker_translation_m
    tracker = Z @ invert(Ts_camera_board) @ invert(X)
    pixels = pixels + rng.normal(scale=motion.pixel_px, size=pixels.shape)
    points = board_points()
    views = BoardViews([points] * motion.num_views, list(pixels), K, DISTORTION)
    return Scene(
        Ts_world_tracker=tracker @ move(noise),
        views=views,
        Ts_camera_board=_poses_of(points, pixels),
        T_tracker_camera=X,
        T_world_board=Z,
    )


def simulated_boards(seed: int, num_views: int) -> FoundBoards:
    """Corners all over the image with the usual noise."""
    views = make_scene(seed, Motion(num_views=num_views, sideways_m=SIDEWAYS_M)).views
    return FoundBoards(
        tuple(points.astype(np.float32) for points in views.points_board),
        tuple(pixels.astype(np.float32) for pixels in views.pixels_px),
        IMAGE_SIZE_PX,
        tuple(range(num_views)),
        num_views,
        CHESSBOARD,
    )


def selected_boards(found: FoundBoards, chosen: Sequence[int]) -> FoundBoards:
    """A subset of the photos, by index into `found.photos`."""
    return replace(
        found,
        points_board=tuple(found.points_board[index] for index in chosen),
        pixels_px=tuple(found.pixels_px[index] for index in chosen),
        photos=tuple(found.photos[index] for index in chosen),
    )


def mount_difference(
    T_tracker_camera_a: np.ndarray, T_tracker_camera_b: np.ndarray
) -> tuple[float, float]:
    """Angle (rad) and distance (m) between two mounts."""
    T_a_b = invert(T_tracker_camera_a) @ T_tracker_camera_b
    return float(rotation_angle(T_a_b[:3, :3])), float(np.linalg.norm(T_a_b[:3, 3]))


def _seen_boards(rng: np.random.Generator, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """True poses of boards inside the image, and the true pixels of their corners."""
    points = board_points()
    low = np.array([MARGIN_PX, MARGIN_PX])
    high = np.array(IMAGE_SIZE_PX) - MARGIN_PX
    poses: list[np.ndarray] = []
    pixels: list[np.ndarray] = []
    for _ in range(MAX_TRIES):
        turn = np.deg2rad(motion.tilt_deg) * rng.uniform(-1, 1, 3) * np.array(motion.axes)
        R = rotation_from_vector(np.array([np.pi, 0.0, 0.0])) @ rotation_from_vector(turn)
        sideways = rng.uniform(-motion.sideways_m, motion.sideways_m, 2)
        middle = np.array([*sideways, rng.uniform(*motion.distance_m)])
        T = transform(R, middle - R @ points.mean(axis=0))
        seen, _ = project(points[None], T[None], K, DISTORTION)
        if (seen > low).all() and (seen < high).all():
            poses.append(T)
            pixels.append(seen[0])
        if len(poses) == motion.num_views:
            return np.array(poses), np.array(pixels)
    raise LimitExceededError(f"scene: {motion} hardly ever shows the whole board")


def _poses_of(points: np.ndarray, pixels: np.ndarray) -> Float64[np.ndarray, "n 4 4"]:
    """Poses of a board by OpenCV's iterative solver, as in a station."""
    import cv2

    poses = []
    for corners in pixels:
        _, turn, shift = cv2.solvePnP(points, corners, K, DISTORTION)
        R = rotation_from_vector(np.asarray(turn, dtype=np.float64).ravel())
        poses.append(transform(R, np.asarray(shift, dtype=np.float64).ravel()))
    return np.array(poses)
