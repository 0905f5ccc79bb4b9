"""Renderer: draws head camera images of known states from one start image, by a small U-Net.

Each pixel is a blend of the warped start image, the objects' texture and the hands' colours, plus a
learned residual; where nothing changed it is the warped start image itself.
"""

import copy
import functools
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import structlog
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from torch import Tensor, nn
from torch.nn import functional

from services.world_model.dynamics.tensor_trees import Traced, by_name, combined, mapped
from services.world_model.network.configuration import RendererConfig
from services.world_model.network.instruction import LastUsed
from services.world_model.rendering.inputs import (
    COARSE_CHANNELS,
    FINE_CHANNELS,
    DrawingInputs,
    PreparedScenes,
    Scenes,
    drawing_inputs,
)
from services.world_model.rendering.rasters import MAX_DRAWN_OBJECTS, SceneStates

logger = structlog.get_logger(__name__)
# Measured: 0.8 with AVX-512 BF16 on an Intel processor without AMX, 1.4 to 1.9 on AMD Zen 4. The
# bound lies between, so that noise of the timing does not choose another precision at a restart.
LEAST_SPEEDUP: Final = 1.15
# Of the timing; chosen: 0.12 to 0.22 s in all on two busy cores.
_ROUNDS: Final = 5
_IMAGES, _SIDE_PX = 2, 64
# Blend weights of the three input colours, then the residual added to the blend.
_OUTPUTS = 6
_WARPED_LOGIT = 2.0
# Chosen: about 1.5 MB of working memory an image; larger blocks are not faster.
_BLOCK_IMAGES: Final = 32
# Starts are 0.2 MB each at 64 px; as many as rollouts are advanced in turn.
_KEPT_STARTS: Final = 64


class ResidualBlock(nn.Module):
    """Two 3×3 convolutions with a skip connection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Float[Tensor, "n width h w"]) -> Float[Tensor, "n width h w"]:
        """The input plus the block's residual."""
        added: Tensor = self.second(functional.relu_(self.first(functional.relu(x))))
        return added.add_(x)


class RendererNetwork(nn.Module):
    """Blends drawn and warped images; fully convolutional, without normalization."""

    def __init__(self, config: RendererConfig) -> None:
        super().__init__()
        self.config = config
        widths, depths = config.widths, config.depths
        inputs = 4 * FINE_CHANNELS + COARSE_CHANNELS
        self.stem = nn.Conv2d(inputs, widths[0], config.stem_px, padding=config.stem_px // 2)
        self.encoder = nn.ModuleList(
            nn.Sequential(*[ResidualBlock(width) for _ in range(depth)])
            for width, depth in zip(widths, depths, strict=True)
        )
        steps = list(pairwise(widths))
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in steps)
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in steps)
        self.decoder = nn.ModuleList(ResidualBlock(a) for a, _ in steps)
        self.head = nn.Conv2d(widths[0], 4 * _OUTPUTS, 3, padding=1)
        # Initially an image is mostly the warped start image, without a residual.
        nn.init.zeros_(self.head.weight)
        bias = torch.zeros(4 * _OUTPUTS)
        bias[:4] = _WARPED_LOGIT
        self.head.bias = nn.Parameter(bias)

    def forward(self, inputs: DrawingInputs) -> Float32[Tensor, "n 3 h w"]:
        """Images in 0 … 1."""
        drawn = self._unet(self._entered(inputs)).contiguous().float()
        drawn = functional.pixel_shuffle(drawn, 2)
        warped, objects, hands = (inputs.fine[:, 3 * i : 3 * i + 3] for i in range(3))
        weights = drawn[:, :3].softmax(dim=1)
        hit = inputs.fine[:, 11:12]
        is_hand = torch.maximum(inputs.fine[:, 9:10], inputs.fine[:, 10:11])
        # Colours exist only where something is hit: elsewhere the weights have no effect.
        mixed = weights[:, 1:2] * hit * (objects - warped)
        mixed = mixed + weights[:, 2:] * is_hand * (hands - warped)
        mixed = mixed + drawn[:, 3:].contiguous().tanh()
        return warped + inputs.change * mixed

    def _entered(self, inputs: DrawingInputs) -> Float[Tensor, "n width rows cols"]:
        """Stem convolution with 2×2 blocks of fine pixels as channels, by a stride."""
        weight, px = self.stem.weight, self.config.stem_px
        dtype, padding = weight.dtype, px // 2
        kernel = weight[:, : 4 * FINE_CHANNELS].reshape(-1, FINE_CHANNELS, 2, 2, px, px)
        kernel = kernel.permute(0, 1, 4, 2, 5, 3).reshape(-1, FINE_CHANNELS, 2 * px, 2 * px)
        entered = functional.conv2d(
            _channels_last(inputs.fine.to(dtype)), kernel, self.stem.bias, 2, 2 * padding
        )
        return entered + functional.conv2d(
            _channels_last(inputs.coarse.to(dtype)), weight[:, 4 * FINE_CHANNELS :], padding=padding
        )

    def _unet(self, x: Tensor) -> Tensor:
        passed = []
        for level, blocks in enumerate(self.encoder):
            x = blocks(x)
            if level < len(self.down):
                passed.append(x)
                x = self.down[level](x)
        for level in reversed(range(len(self.down))):
            x = functional.interpolate(self.up[level](x), scale_factor=2.0, mode="nearest")
            x = self.decoder[level](x.add_(passed[level]))
        out: Tensor = self.head(functional.relu_(x))
        return out


def _channels_last(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last)


@functools.cache
def has_fast_bfloat16() -> bool:
    """Whether convolutions are clearly faster in bfloat16 than in float32; timed once."""
    # Older versions of torch do not tell; there float32 is right, too.
    found: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    if not (found.get("amx_bf16", False) or found.get("avx512_bf16", False)):
        return False
    speedup = bfloat16_speedup()
    is_faster = speedup >= LEAST_SPEEDUP
    logger.info(
        "convolution_precision_chosen", precision="bfloat16" if is_faster else "float32",
        bfloat16_speedup=round(speedup, 2), least_speedup=LEAST_SPEEDUP,
    )  # fmt: skip
    return is_faster


def uses_bfloat16(*, setting: bool | None) -> bool:
    """A setting, or what is faster here where it is None."""
    return has_fast_bfloat16() if setting is None else setting


def bfloat16_speedup(clock: Callable[[], float] = time.thread_time) -> float:
    """Time of the renderer's layers in float32 over that in bfloat16, median of alternate runs."""
    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        single = RendererNetwork(RendererConfig()).eval()
        half = copy.deepcopy(single).to(torch.bfloat16)
        inputs = DrawingInputs(
            torch.rand(_IMAGES, FINE_CHANNELS, _SIDE_PX, _SIDE_PX),
            torch.rand(_IMAGES, COARSE_CHANNELS, _SIDE_PX // 2, _SIDE_PX // 2),
            torch.ones(_IMAGES, 1, _SIDE_PX, _SIDE_PX),
        )

    def seconds(network: RendererNetwork) -> float:
        started = clock()
        network(inputs)
        return clock() - started

    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            seconds(single), seconds(half)
            ratios = [seconds(single) / seconds(half) for _ in range(_ROUNDS)]
    finally:
        torch.set_num_threads(threads)
    return statistics.median(ratios)


@dataclass(frozen=True)
class Drawing:
    """States of one rollout to draw: the first is that of `start_image`; boxes as of `Scenes`."""

    start_image: UInt8[np.ndarray, "h w 3"]
    K_head: Float64[np.ndarray, "3 3"]
    states: SceneStates
    boxes_m: Float64[np.ndarray, "k 6"]


class Renderer:
    """Draws head camera images of states; equal inputs give equal bytes.

    By default, convolutions run in bfloat16 if that is clearly faster on this processor.
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
        # A rollout draws all its chunks from one start.
        self._starts = LastUsed[PreparedScenes](_KEPT_STARTS)
        self._lock = threading.Lock()

    def draw_all(self, drawings: Sequence[Drawing]) -> list[UInt8[np.ndarray, "n h w 3"]]:
        """Draw images of any number of rollouts; together as alone, except for rounding."""
        if not drawings:
            return []
        starts = [self._prepared(drawing) for drawing in drawings]
        later = [one.states.take(slice(1, None)).padded(MAX_DRAWN_OBJECTS) for one in drawings]
        counts = [len(states) for states in later]
        states = combined(later, np.concatenate)
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
        prepared = combined([starts[index] for index in used], np.concatenate)
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
        arrays = by_name(scenes).values()
        key = b"".join(array.tobytes() for array in arrays) + str(scenes.images.shape).encode()
        with self._lock:
            return self._starts.of([key], lambda _: [PreparedScenes.of(copy.deepcopy(scenes))])[0]
