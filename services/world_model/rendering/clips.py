"""Training clips of the renderer: images of an episode with the states they show."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from dextouch.errors import ShapeError
from services.world_model.rendering.inputs import Scenes
from services.world_model.rendering.scene_states import SceneStates


@dataclass(frozen=True)
class SceneClip:
    """Images of one episode at `steps`, with the ground-truth state at each of them.

    `boxes_m` holds centre and half sizes (x y z, x y z) of each object's box in the object frame.
    """

    steps: Int64[np.ndarray, " images"]
    images: UInt8[np.ndarray, "images h w 3"]
    states: SceneStates
    K_head: Float64[np.ndarray, "3 3"]
    boxes_m: Float64[np.ndarray, "k 6"]

    def __post_init__(self) -> None:
        lengths = {len(self.steps), len(self.images), len(self.states)}
        if len(lengths) > 1 or len(self.steps) < 2:
            raise ShapeError(
                f"scene clip: got {len(self.steps)} steps, {len(self.images)} images and "
                f"{len(self.states)} states, expected equal numbers of at least two"
            )

    def __len__(self) -> int:
        return len(self.steps)


def gather(
    clips: Sequence[SceneClip], rows: Int64[np.ndarray, "b 2"]
) -> tuple[Scenes, UInt8[np.ndarray, "b h w 3"]]:
    """Images and states at rows (clip, image), as scenes; missing object slots are empty."""
    num_slots = max(len(clips[clip].boxes_m) for clip, _ in rows)
    boxes_m = np.zeros((len(rows), num_slots, 6))
    poses = np.zeros((len(rows), num_slots, 7))
    poses[..., 3] = 1.0
    present = np.zeros((len(rows), num_slots), dtype=np.bool_)
    for row, (clip, image) in enumerate(rows):
        known = clips[clip]
        slots = slice(0, len(known.boxes_m))
        boxes_m[row, slots] = known.boxes_m
        poses[row, slots] = known.states.object_poses[image]
        present[row, slots] = known.states.object_present[image]
    states = SceneStates(
        np.stack([clips[c].states.Ts_world_camera[i] for c, i in rows]),
        np.stack([clips[c].states.Ts_world_wrist[i] for c, i in rows]),
        np.stack([clips[c].states.joints_rad[i] for c, i in rows]),
        poses,
        present,
    )
    images = np.stack([clips[c].images[i] for c, i in rows])
    return Scenes(images, np.stack([clips[c].K_head for c, _ in rows]), states, boxes_m), images
