"""Renderer: draws head camera images of known states from one start image."""

import copy
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from services.world_model.rendering.configuration import RendererConfig
from services.world_model.rendering.inputs import (
    DrawingInputs,
    PreparedScenes,
    Scenes,
    drawing_inputs_from,
)
from services.world_model.rendering.network import RendererNetwork
from services.world_model.rendering.precision import uses_bfloat16 as uses_bfloat16_here
from services.world_model.rendering.scene_states import SceneState, SceneStates


class Renderer:
    """Draws head camera images of states; equal inputs give equal bytes.

    Args:
        network: trained weights; they are copied.
        uses_bfloat16: run convolutions in bfloat16; default: if that is clearly faster on this
            processor, which is timed once in a process.
    """

    def __init__(self, network: RendererNetwork, *, uses_bfloat16: bool | None = None) -> None:
        dtype = torch.bfloat16 if uses_bfloat16_here(setting=uses_bfloat16) else torch.float32
        self._network = copy.deepcopy(network).eval().requires_grad_(requires_grad=False)
        self._network.to(dtype)
        # A rollout draws all its chunks from one start.
        self._last_start: tuple[bytes, PreparedScenes] | None = None

    @property
    def config(self) -> RendererConfig:
        """Shape of the network."""
        return self._network.config

    def draw(
        self,
        start_image: np.ndarray,
        K_head: np.ndarray,
        start: SceneState,
        states: Sequence[SceneState],
        boxes_m: np.ndarray,
    ) -> UInt8[np.ndarray, "n h w 3"]:
        """Draw images of states that follow a start, or precede it.

        If camera, hands and objects are where they were at the start, the image is exactly the
        start image.

        Args:
            start_image: uint8 [h, w, 3], the head camera image at the start.
            K_head: intrinsics [3, 3] in pixels; lens distortion is not modelled.
            start: state at the start.
            states: states to draw, at least one.
            boxes_m: [k, 6], centre and half sizes (x y z, x y z) of the bounding box of each object
                slot, in the object frame.

        Raises:
            ShapeError: wrong array shapes, no state, or object slots that do not match the boxes.
            InvalidInputError: image sides that the network does not support.
            NonFiniteError: NaN or infinity.
        """
        scenes = self._scene(start_image, K_head, start, boxes_m)
        stacked = SceneStates.stack(states)
        if stacked.object_present.shape[1] != len(boxes_m):
            raise ShapeError(
                f"renderer: states have {stacked.object_present.shape[1]} object slots but there "
                f"are {len(boxes_m)} boxes; expected equal numbers"
            )
        owner = np.zeros(len(states), dtype=np.int64)
        with torch.inference_mode():
            prepared = self._prepared(scenes)
            images = self._drawn(drawing_inputs_from(prepared, stacked, owner, self.config))
            rounded = (images * 255.0).round_().clamp_(0, 255).to(torch.uint8)
            return np.ascontiguousarray(rounded.permute(0, 2, 3, 1).numpy())

    def _drawn(self, inputs: DrawingInputs) -> Float32[Tensor, "n 3 h w"]:
        """Images in 0 … 1; the network runs only where something changed."""
        changed = inputs.change.flatten(1).amax(dim=1) > 0
        if bool(changed.all()):
            return self._network(inputs)
        images = inputs.fine[:, :3].clone()
        if bool(changed.any()):
            some = DrawingInputs(
                inputs.fine[changed], inputs.coarse[changed], inputs.change[changed]
            )
            images[changed] = self._network(some)
        return images

    def _prepared(self, scenes: Scenes) -> PreparedScenes:
        """Prepared scenes; those of the last start are cached."""
        states = scenes.states
        arrays = (
            scenes.images, scenes.K_head, scenes.boxes_m, states.Ts_world_camera,
            states.Ts_world_wrist, states.joints_rad, states.object_poses, states.object_present,
        )  # fmt: skip
        key = b"".join(array.tobytes() for array in arrays) + bytes(
            str(scenes.images.shape), "ascii"
        )
        last = self._last_start
        if last is None or last[0] != key:
            copied = copy.deepcopy(scenes)
            last = self._last_start = (key, PreparedScenes.of(copied))
        return last[1]

    def _scene(
        self,
        start_image: np.ndarray,
        K_head: np.ndarray,
        start: SceneState,
        boxes_m: np.ndarray,
    ) -> Scenes:
        if start_image.ndim != 3 or start_image.shape[2] != 3 or start_image.dtype != np.uint8:
            raise ShapeError(
                f"renderer: got a start image {start_image.dtype} {start_image.shape}, expected "
                "uint8 [h, w, 3]"
            )
        multiple = self.config.pixel_multiple
        if any(side % multiple or side == 0 for side in start_image.shape[:2]):
            raise InvalidInputError(
                f"renderer: got a start image of {start_image.shape[:2]} px, expected sides that "
                f"are multiples of {multiple}"
            )
        K, boxes = np.asarray(K_head, dtype=np.float64), np.asarray(boxes_m, dtype=np.float64)
        if K.shape != (3, 3) or boxes.shape != (len(start.object_present), 6):
            raise ShapeError(
                f"renderer: got K_head {K.shape} and boxes {boxes.shape}, expected (3, 3) and "
                f"({len(start.object_present)}, 6) for the start's object slots"
            )
        if not (np.isfinite(K).all() and np.isfinite(boxes).all()):
            raise NonFiniteError("renderer: K_head or boxes contain NaN or infinity")
        return Scenes(start_image[None], K[None], SceneStates.stack([start]), boxes[None])
