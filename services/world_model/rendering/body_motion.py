"""Image motion of hands and objects relative to the start image warped by the camera motion."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.geometry import apply, invert
from services.world_model.rendering.box_raster import box_corners, object_transforms
from services.world_model.rendering.camera_motion import CameraMotion
from services.world_model.rendering.hand_raster import MIN_DEPTH_M, base_points_world
from services.world_model.rendering.scene_states import SceneStates

# A body shifted less than the first against the warped image is still, one shifted more than the
# second has moved; in between its motion share is interpolated.
STILL_PX, MOVED_PX = 0.05, 0.3


@dataclass(frozen=True)
class Bodies:
    """Hands and object boxes in one camera per state.

    `pixels` and `in_front` cover 22 points of each hand, then the eight corners of each box.
    """

    Ts_camera_box: Float64[np.ndarray, "n k 4 4"]
    hands_world: Float64[np.ndarray, "n 2 22 3"]
    pixels: Float64[np.ndarray, "n points 2"]
    in_front: Bool[np.ndarray, "n points"]

    @classmethod
    def seen(cls, states: SceneStates, boxes_m: np.ndarray, K: np.ndarray) -> "Bodies":
        """Bodies of states with object boxes [n, k, 6], seen by cameras [n, 3, 3]."""
        T_camera_world = invert(states.Ts_world_camera)
        Ts_object_box = np.tile(np.eye(4), (*boxes_m.shape[:2], 1, 1))
        Ts_object_box[..., :3, 3] = boxes_m[..., :3]
        Ts_world_box = object_transforms(states.object_poses) @ Ts_object_box
        Ts_camera_box = T_camera_world[:, None] @ Ts_world_box
        hands_world = base_points_world(states)
        corners = box_corners(Ts_camera_box, boxes_m[..., 3:])
        points = np.concatenate(
            [
                apply(T_camera_world, hands_world.reshape(len(states), -1, 3)),
                corners.reshape(len(states), -1, 3),
            ],
            axis=1,
        )
        depth = points[..., 2:]
        pixels = (points @ np.swapaxes(K, -1, -2))[..., :2] / np.maximum(depth, MIN_DEPTH_M)
        return cls(Ts_camera_box, hands_world, pixels, depth[..., 0] > MIN_DEPTH_M)


def motion_shares(
    before: Bodies,
    now: Bodies,
    owner: Int64[np.ndarray, " n"],
    motion: CameraMotion,
) -> Float64[np.ndarray, "n bodies"]:
    """Motion share, from 0 (still) to 1 (moved), of left hand, right hand and each object.

    A body moves when any of its points leaves its position in the warped start image.
    """
    there = before.pixels[owner]
    shift = np.linalg.norm(motion.to_start(now.pixels) - there, axis=-1)
    both = before.in_front[owner] & now.in_front
    shift = np.where(both, shift, 0.0)
    # Points that crossed the camera plane have moved.
    shift[before.in_front[owner] != now.in_front] = np.inf
    hands, boxes = shift[:, :44].reshape(-1, 2, 22), shift[:, 44:].reshape(len(owner), -1, 8)
    largest = np.concatenate([hands.max(axis=-1), boxes.max(axis=-1)], axis=1)
    return np.asarray(((largest - STILL_PX) / (MOVED_PX - STILL_PX)).clip(0.0, 1.0))
