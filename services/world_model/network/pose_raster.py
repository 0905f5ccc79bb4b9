"""Raster of both hands in the head image, drawn from the poses and joint angles of a window.

The paper conditions by AdaLN alone; the raster of the projected hands is an addition. It shows the
network, to within about one cell, where in the image the hands will be.
"""

from functools import cache

import numpy as np
from jaxtyping import Float32, Float64

from dextouch.geometry import apply, invert, project
from dextouch.hands.actions import CAMERA_HEAD as CAMERA
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, WRIST_LEFT, WRIST_RIGHT, pose_from_9d
from dextouch.hands.robot_hand import RobotHand

# Standard deviation of a point's Gaussian blot, in raster cells.
BLOT_CELLS = 1.0
_WRIST_AND_SIDES = (("left", WRIST_LEFT, JOINTS_LEFT), ("right", WRIST_RIGHT, JOINTS_RIGHT))


@cache
def _hand(side: str) -> RobotHand:
    return RobotHand(side)


def hand_points_m(joints_rad: np.ndarray, *, side: str) -> Float64[np.ndarray, "*batch 21 3"]:
    """Wrist and four points per finger in wrist coordinates, for joint angles [..., 20]."""
    joints = np.asarray(joints_rad, dtype=np.float64)
    batch = joints.shape[:-1]
    chains = _hand(side).chain_points_m(joints.reshape(-1, 20)).reshape(*batch, 20, 3)
    return np.concatenate([np.zeros((*batch, 1, 3)), chains], axis=-2)


def blots(
    pixels: np.ndarray, visible: np.ndarray, *, image_px: int, cells: int
) -> Float32[np.ndarray, "*batch cells cells"]:
    """Gaussian blots of points [..., n, 2] on a cells × cells raster of the image, in 0 … 1."""
    position = pixels.astype(np.float32) * (cells / image_px)
    centres = np.arange(cells, dtype=np.float32) + 0.5
    across = np.exp(-0.5 * np.square((centres - position[..., :1]) / BLOT_CELLS))
    down = np.exp(-0.5 * np.square((centres - position[..., 1:]) / BLOT_CELLS))
    down = down * visible[..., None].astype(np.float32)
    # Overlapping blots saturate at one instead of adding up.
    return (1.0 - np.exp(-np.swapaxes(down, -1, -2) @ across)).astype(np.float32)


def pose_raster(
    actions: np.ndarray, anchors: np.ndarray, K_head: np.ndarray, *, image_px: int, cells: int
) -> Float32[np.ndarray, "batch time 2 cells cells"]:
    """Rasters of both hands at the poses of the actions, seen by the moving head camera.

    Args:
        actions: [B, T, 67] relative to the anchors.
        anchors: [B, 3, 4, 4] T_world of left wrist, right wrist and head camera at step 0.
        K_head: [B, 3, 3] in pixels of the image; lens distortion is not applied.
        image_px: side of the square image.
        cells: side of the raster.

    Returns:
        Left hand, then right hand; points behind the camera leave no blot.
    """
    actions = np.asarray(actions, dtype=np.float64)
    Ts_world_camera = anchors[:, None, 2] @ pose_from_9d(actions[..., CAMERA])
    Ts_camera_world = invert(Ts_world_camera)
    rasters = []
    for index, (side, wrist, joints) in enumerate(_WRIST_AND_SIDES):
        Ts_world_wrist = anchors[:, None, index] @ pose_from_9d(actions[..., wrist])
        points_wrist = hand_points_m(actions[..., joints], side=side)
        points_camera = apply(Ts_camera_world @ Ts_world_wrist, points_wrist)
        pixels, visible = _project_each(K_head, points_camera)
        # Far outside the image a blot is zero; clipping keeps float32 squares finite.
        pixels = np.clip(pixels, -10.0 * image_px, 10.0 * image_px)
        rasters.append(blots(pixels, visible, image_px=image_px, cells=cells))
    return np.stack(rasters, axis=2)


def _project_each(K_head: np.ndarray, points_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pairs = [project(K, points) for K, points in zip(K_head, points_camera, strict=True)]
    return np.stack([pixels for pixels, _ in pairs]), np.stack([front for _, front in pairs])
