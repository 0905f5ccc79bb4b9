"""Renderer: draws head camera images of known states from one start image."""

import copy
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from torch import Tensor

from services.world_model.dynamics.trees import Traced, mapped
from services.world_model.rendering.inputs import (
    DrawingInputs,
    PreparedScenes,
    Scenes,
    drawing_inputs,
)
from services.world_model.rendering.network import RendererNetwork, has_fast_bfloat16
from services.world_model.rendering.rasters import MAX_DRAWN_OBJECTS, SceneStates, joined

# Chosen: about 1.5 MB of working memory an image; larger blocks are not faster.
_BLOCK_IMAGES: Final = 32
# Starts are 0.2 MB each at 64 px; as many as rollouts are advanced in turn.
_KEPT_STARTS: Final = 64


@dataclass(frozen=True)
class Drawing:
    """States of one rollout to draw.

    `start_image` is the head camera image at the start, and `states` the state there, then those to
    draw; `boxes_m` are as of `Scenes`. Lens distortion is not modelled.
    """

    start_image: UInt8[np.ndarray, "h w 3"]
    K_head: Float64[np.ndarray, "3 3"]
    states: SceneStates
    boxes_m: Float64[np.ndarray, "k 6"]


class Renderer:
    """Draws head camera images of states; equal inputs give equal bytes.

    The network is copied. By default, convolutions run in bfloat16 if that is clearly faster on
    this processor, which is timed once in a process.
    """

    def __init__(self, network: RendererNetwork, *, uses_bfloat16: bool | None = None) -> None:
        is_half = has_fast_bfloat16() if uses_bfloat16 is None else uses_bfloat16
        self._network = copy.deepcopy(network).eval().requires_grad_(requires_grad=False)
        self._network.to(torch.bfloat16 if is_half else torch.float32)
        # As the images are, so that convolutions do not rearrange their weights at each call.
        for weight in self._network.parameters():
            if weight.ndim == 4:
                weight.data = weight.data.contiguous(memory_format=torch.channels_last)
        call = self._network.__call__
        self._paint = Traced(self._network, call, lambda inputs: inputs.fine.shape)
        # A rollout draws all its chunks from one start. Those used last are at the end.
        self._starts: OrderedDict[bytes, PreparedScenes] = OrderedDict()
        self._lock = threading.Lock()

    def draw_all(self, drawings: Sequence[Drawing]) -> list[UInt8[np.ndarray, "n h w 3"]]:
        """Draw images of any number of rollouts; together as alone, except for rounding.

        Start images have one size, whose sides are multiples of `pixel_multiple`. Where nothing
        moved since the start, the image is exactly the start image.
        """
        if not drawings:
            return []
        starts = [self._prepared(drawing) for drawing in drawings]
        later = [one.states.take(slice(1, None)).padded(MAX_DRAWN_OBJECTS) for one in drawings]
        counts = [len(states) for states in later]
        states = joined(later)
        owner = np.repeat(np.arange(len(drawings)), counts)
        ends = range(_BLOCK_IMAGES, len(states), _BLOCK_IMAGES)
        blocks = [
            self._drawn_block(starts, states.take(rows), owner[rows])
            for rows in np.split(np.arange(len(states)), ends)
        ]
        return np.split(np.concatenate(blocks), np.cumsum(counts)[:-1])

    def _drawn_block(
        self, starts: Sequence[PreparedScenes], states: SceneStates, owner: np.ndarray
    ) -> UInt8[np.ndarray, "n h w 3"]:
        used, local = np.unique(owner, return_inverse=True)
        prepared = joined([starts[index] for index in used])
        with torch.inference_mode():
            images = self._drawn(drawing_inputs(prepared, states, local, self._network.config))
            rounded = (images * 255.0).round_().clamp_(0, 255).to(torch.uint8)
            return np.ascontiguousarray(rounded.permute(0, 2, 3, 1).numpy())

    def _drawn(self, inputs: DrawingInputs) -> Float32[Tensor, "n 3 h w"]:
        """Images in 0 … 1; the network runs only where something changed."""
        changed = inputs.change.flatten(1).amax(dim=1) > 0
        if bool(changed.all()):
            # One image is what policies ask for: calling its operations takes a tenth of the time.
            return self._paint(inputs) if len(changed) == 1 else self._network(inputs)
        images = inputs.fine[:, :3].clone()
        if bool(changed.any()):
            images[changed] = self._network(mapped(inputs, lambda planes: planes[changed]))
        return images

    def _prepared(self, drawing: Drawing) -> PreparedScenes:
        """The prepared start of a drawing; those that were used last are kept."""
        start = drawing.states.take(slice(0, 1)).padded(MAX_DRAWN_OBJECTS)
        boxes_m = np.zeros((1, MAX_DRAWN_OBJECTS, 6))
        boxes_m[0, : len(drawing.boxes_m)] = drawing.boxes_m
        scenes = Scenes(drawing.start_image[None], drawing.K_head[None], start, boxes_m)
        arrays = [scenes.images, scenes.K_head, scenes.boxes_m]
        arrays += [getattr(scenes.states, field.name) for field in fields(scenes.states)]
        key = b"".join(array.tobytes() for array in arrays) + str(scenes.images.shape).encode()
        with self._lock:
            prepared = self._starts.get(key)
            if prepared is None:
                prepared = self._starts[key] = PreparedScenes.of(copy.deepcopy(scenes))
            self._starts.move_to_end(key)
            if len(self._starts) > _KEPT_STARTS:
                self._starts.popitem(last=False)
        return prepared
