"""The tactile side of the joint model: tokenizers of pressure, and the expert on their latents."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from dextouch.errors import InvalidInputError
from dextouch.tactile import PADS
from dextouch.tactile.layout import TactileLayout
from services.world_model.dynamics.features import principal_axes, root_pressure, root_scale
from services.world_model.network.attention import (
    NUM_MODULATIONS,
    Stream,
    angles,
    modulated_norm,
    split_axis,
    tactile_positions,
    zero_linear,
)
from services.world_model.network.conditioning import Condition
from services.world_model.network.configuration import NetworkConfig

Pressures = Float32[Tensor, "*batch taxels"]
Latents = Float32[Tensor, "*batch tokens channels"]
NUM_PADS = 6
# Amplitude of palms relative to that of tips; the best value in an ablation on touch.
PALM_SCALE = 0.7
_CANVAS_MULTIPLE = 4
# For checkpoints without a stored training peak: twice the peak of eight demonstrations of the
# twin's first two tasks.
UNKNOWN_PEAK_KPA = 200.0


class TactileTokenizer(nn.Module, ABC):
    """Encoder and decoder of the taxels of one hand; zero pressure is the zero latent.

    All work on the square root of pressure, which gives light touch more weight, and are frozen
    while a world model is trained on their latents. A hand is `num_tokens` tokens of `channels`
    values each. `peak_kpa` is the highest pressure in training.
    """

    peak_kpa: Tensor

    def __init__(self, *, num_tokens: int, channels: int) -> None:
        super().__init__()
        self.num_tokens, self.channels = num_tokens, channels
        self.register_buffer("peak_kpa", torch.full((), UNKNOWN_PEAK_KPA))

    @abstractmethod
    def fit(self, tactile_kpa: Float32[Tensor, "n 2 taxels"]) -> None:
        """Fit what follows from training touch in closed form, including `peak_kpa`."""

    @abstractmethod
    def encode(self, tactile_kpa: Pressures) -> Latents:
        """Latents; pressures below zero count as zero."""

    @abstractmethod
    def decode(self, latents: Latents) -> Pressures:
        """Pressures in kPa, never below zero."""

    def bounded(
        self,
        tactile_kpa: Float32[Tensor, "batch steps 2 taxels"],
        first_kpa: Float32[Tensor, "batch 2 taxels"],
    ) -> Float32[Tensor, "batch steps 2 taxels"]:
        """Clip decoded pressures to the larger of the training peak and the first touch's peak."""
        highest_kpa = torch.maximum(first_kpa.flatten(1).amax(dim=1), self.peak_kpa)
        return torch.minimum(tactile_kpa, highest_kpa[:, None, None, None])


class LearnedTokenizer(TactileTokenizer):
    """Autoencoder of root pressures in units of their root mean square (`train tokenizer`)."""

    root_scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        num_tokens = NUM_PADS if config.tactile_tokens == "pad" else 1
        super().__init__(num_tokens=num_tokens, channels=config.tactile_channels // num_tokens)
        self._num_taxels = config.tactile_layout.num_taxels
        self.register_buffer("root_scale", torch.ones(()))

    @abstractmethod
    def encode_roots(self, roots: Float32[Tensor, "n taxels"]) -> Float32[Tensor, "n latents"]:
        """Latents of scaled root pressures."""

    @abstractmethod
    def decode_roots(self, latents: Float32[Tensor, "n latents"]) -> Float32[Tensor, "n taxels"]:
        """Scaled root pressures of latents; values may be below zero."""

    def fit(self, tactile_kpa: Float32[Tensor, "n 2 taxels"]) -> None:
        """Fit the scale and `peak_kpa`; the weights are learned by gradient."""
        self.root_scale.copy_(root_pressure(tactile_kpa).square().mean().sqrt().clamp_min(1e-3))
        self.peak_kpa.copy_(tactile_kpa.max())

    def encode(self, tactile_kpa: Pressures) -> Latents:
        """Latents; pressures below zero count as zero."""
        roots = root_pressure(tactile_kpa).reshape(-1, self._num_taxels) / self.root_scale
        latents = self.encode_roots(roots)
        return latents.reshape(*tactile_kpa.shape[:-1], self.num_tokens, self.channels)

    def decode(self, latents: Latents) -> Pressures:
        """Pressures in kPa, never below zero."""
        return self.roots(latents).clamp_min(0.0).square()

    def roots(self, latents: Latents) -> Pressures:
        """Root pressures (√kPa), which the loss compares; values may be below zero."""
        flat = latents.reshape(-1, self.num_tokens * self.channels)
        return split_axis(self.decode_roots(flat), 0, latents.shape[:-2]) * self.root_scale


@dataclass(frozen=True)
class MapShape:
    """Shape of the maps that one convolutional autoencoder handles, and its size.

    Layers have no biases and embeddings multiply features, so that an untouched map is the zero
    latent and the reverse. The `num_maps` maps of a hand differ by an identity embedding.
    `channels` are latent values of each map, `width` is that of the convolutions, and `hidden` that
    of the layer between features and latents. The encoder halves the resolution `num_halvings`
    times.
    """

    rows: int
    columns: int
    num_maps: int
    channels: int
    width: int
    hidden: int
    num_halvings: int

    @property
    def lowest(self) -> tuple[int, int]:
        """Rows and columns at the lowest resolution, rounded up."""
        cells = 2**self.num_halvings
        return -(-self.rows // cells), -(-self.columns // cells)

    @property
    def num_features(self) -> int:
        """Values of a map at the lowest resolution."""
        rows, columns = self.lowest
        return self.width * rows * columns


class MapEncoder(nn.Module):
    """Encodes every map of a hand by the same weights."""

    def __init__(self, shape: MapShape) -> None:
        super().__init__()
        self.first = _convolution(1, shape.width)
        self.position = nn.Parameter(torch.zeros(shape.width, shape.rows, shape.columns))
        layers: list[nn.Module] = []
        for stride in [2] * shape.num_halvings or [1]:
            layers += [_convolution(shape.width, shape.width, stride=stride), nn.GELU()]
        features = nn.Linear(shape.num_features, shape.hidden, bias=False)
        self.deeper = nn.Sequential(*layers, nn.Flatten(), features)
        self.identity = nn.Parameter(0.1 * torch.randn(shape.num_maps, shape.hidden))
        self.to_latents = nn.Linear(shape.hidden, shape.channels, bias=False)

    def forward(
        self, maps: Float32[Tensor, "n maps rows columns"]
    ) -> Float32[Tensor, "n maps channels"]:
        """Latents of each map."""
        features = functional.gelu(self.first(maps.flatten(0, 1)[:, None])) * (1.0 + self.position)
        hidden = split_axis(self.deeper(features), 0, maps.shape[:2])
        return self.to_latents(functional.gelu(hidden * (1.0 + self.identity)))


class MapDecoder(nn.Module):
    """Decodes the latents of every map of a hand by the same weights."""

    def __init__(self, shape: MapShape) -> None:
        super().__init__()
        self._shape = shape
        self.from_latents = nn.Linear(shape.channels, shape.hidden, bias=False)
        self.identity = nn.Parameter(0.1 * torch.randn(shape.num_maps, shape.hidden))
        self.to_features = nn.Linear(shape.hidden, shape.num_features, bias=False)
        layers: list[nn.Module] = [nn.GELU()]
        for _ in range(shape.num_halvings - 1):
            convolution = _convolution(shape.width, shape.width)
            layers += [nn.Upsample(scale_factor=2), convolution, nn.GELU()]
        self.deeper = nn.Sequential(*layers)
        # The last doubling of the resolution writes four cells per feature.
        factor = 2 if shape.num_halvings else 1
        rows, columns = (n * 2**shape.num_halvings // factor for n in shape.lowest)
        self.position = nn.Parameter(torch.zeros(shape.width, rows, columns))
        self.last = nn.Sequential(_convolution(shape.width, factor**2), nn.PixelShuffle(factor))

    def forward(
        self, latents: Float32[Tensor, "n maps channels"]
    ) -> Float32[Tensor, "n maps rows columns"]:
        """Maps of the latents; values may be below zero."""
        shape = self._shape
        hidden = functional.gelu(self.from_latents(latents) * (1.0 + self.identity))
        flat = self.to_features(hidden).flatten(0, 1)
        features = self.deeper(split_axis(flat, 1, (shape.width, *shape.lowest)))
        maps = self.last(features * (1.0 + self.position))[:, 0, : shape.rows, : shape.columns]
        return split_axis(maps, 0, latents.shape[:2])


def _convolution(in_width: int, out_width: int, *, stride: int = 1) -> nn.Conv2d:
    """Three by three cells without a bias."""
    return nn.Conv2d(in_width, out_width, 3, stride=stride, padding=1, bias=False)


def canvas_cells(layout: TactileLayout) -> tuple[np.ndarray, tuple[int, int]]:
    """Cell of the canvas, counted row by row, of each taxel, and the canvas' rows and columns.

    Fingers are side by side in the top rows, thumb to little finger, the palm below, in the middle.
    Inside every pad rows run from distal to proximal and columns from radial to ulnar.
    """
    fingers, palm = layout.fingers, layout.palm
    palm_shape = (0, 0) if palm is None else palm.shape
    finger_rows = max((pad.rows for pad in fingers), default=0)
    width = max(sum(pad.columns for pad in fingers), palm_shape[1])
    # Whole cells at the lowest resolution, a quarter of the canvas'.
    sizes = (finger_rows + palm_shape[0], width)
    shape = tuple(-(-size // _CANVAS_MULTIPLE) * _CANVAS_MULTIPLE for size in sizes)
    cells = np.arange(shape[0] * shape[1]).reshape(shape)
    places, column = [], 0
    for pad in fingers:
        places.append(cells[: pad.rows, column : column + pad.columns].ravel())
        column += pad.columns
    if palm is not None:
        left = (width - palm.columns) // 2
        block = cells[finger_rows : finger_rows + palm.rows, left : left + palm.columns]
        places.append(block.ravel())
    return np.concatenate(places), (shape[0], shape[1])


class GridTokenizer(LearnedTokenizer):
    """One autoencoder for palm and fingertips on one canvas, the paper's baseline of equal size."""

    _cells: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        cells, self._canvas_shape = canvas_cells(config.tactile_layout)
        # The most accurate of three sizes with as many weights as Split-Hands.
        shape = MapShape(
            *self._canvas_shape, num_maps=1, channels=config.tactile_channels, width=24, hidden=90,
            num_halvings=2,
        )  # fmt: skip
        self.encoder, self.decoder = MapEncoder(shape), MapDecoder(shape)
        self.register_buffer("_cells", torch.from_numpy(cells), persistent=False)

    def encode_roots(self, roots: Float32[Tensor, "n taxels"]) -> Float32[Tensor, "n latents"]:
        """Latents of the canvas."""
        rows, columns = self._canvas_shape
        canvas = roots.new_zeros(len(roots), rows * columns)
        canvas[:, self._cells] = roots
        return self.encoder(canvas.reshape(-1, 1, rows, columns)).flatten(1)

    def decode_roots(self, latents: Float32[Tensor, "n latents"]) -> Float32[Tensor, "n taxels"]:
        """Root pressures at the taxels' cells."""
        return self.decoder(latents[:, None]).flatten(1)[:, self._cells]


class SplitHandsTokenizer(LearnedTokenizer):
    """One autoencoder for fingertips, one for palms, as in the paper.

    A hand is one token per pad (`tactile_tokens` "pad", as in the paper) or all of them in one
    token ("hand", several times cheaper in the world model); the weights are the same.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        layout, channels = config.tactile_layout, config.tactile_channels // NUM_PADS
        shapes = {pad.shape for pad in layout.fingers}
        if len(layout.pads) != len(PADS) or len(shapes) != 1 or layout.palm is None:
            raise InvalidInputError(
                f"tokenizer split_hands: got layout {layout.name!r} with pads "
                f"{[(pad.part, *pad.shape) for pad in layout.pads]}, expected five fingers of one "
                "shape and a palm; train with --tokenizer grid"
            )
        self._tip_shape, self._palm_shape = shapes.pop(), layout.palm.shape
        self._num_fingers = len(layout.fingers)
        self._num_finger_taxels = layout.num_finger_taxels
        tip = MapShape(
            *self._tip_shape, num_maps=self._num_fingers, channels=channels, width=16, hidden=64,
            num_halvings=0,
        )  # fmt: skip
        palm = MapShape(
            *self._palm_shape, num_maps=1, channels=channels, width=24, hidden=128, num_halvings=2
        )
        self.tip_encoder, self.tip_decoder = MapEncoder(tip), MapDecoder(tip)
        self.palm_encoder, self.palm_decoder = MapEncoder(palm), MapDecoder(palm)

    def encode_roots(self, roots: Float32[Tensor, "n taxels"]) -> Float32[Tensor, "n latents"]:
        """Latents of the five fingertips, then of the palm."""
        first = self._num_finger_taxels
        tips = split_axis(roots[:, :first], 1, (self._num_fingers, *self._tip_shape))
        palm = split_axis(roots[:, first:], 1, (1, *self._palm_shape))
        return torch.cat([self.tip_encoder(tips), self.palm_encoder(palm)], dim=1).flatten(1)

    def decode_roots(self, latents: Float32[Tensor, "n latents"]) -> Float32[Tensor, "n taxels"]:
        """Root pressures of the five fingertips, then of the palm."""
        pads = split_axis(latents, 1, (NUM_PADS, -1))
        tips = self.tip_decoder(pads[:, : self._num_fingers]).flatten(1)
        palm = self.palm_decoder(pads[:, self._num_fingers :]).flatten(1)
        return torch.cat([tips, palm], dim=1)


class PrincipalAxesTokenizer(TactileTokenizer):
    """Tips as they are and palms along their principal axes, as one token, in closed form."""

    tip_scale: Tensor
    palm_basis: Tensor
    palm_scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        layout = config.tactile_layout
        num_tips = layout.num_finger_taxels
        num_palm = layout.num_taxels - layout.num_finger_taxels
        if config.use_touch and config.palm_channels > num_palm:
            fewer = "use fewer palm_channels, or " if num_palm else ""
            raise InvalidInputError(
                f"tokenizer principal_axes: got palm_channels {config.palm_channels} for layout "
                f"{layout.name!r}, expected at most {num_palm}, the taxels of its palm; {fewer}"
                "train a tokenizer by `dextouch train tokenizer --tokenizer grid`"
            )
        super().__init__(num_tokens=1, channels=num_tips + config.palm_channels)
        self._num_tips = num_tips
        self.register_buffer("tip_scale", torch.ones(()))
        self.register_buffer("palm_basis", torch.eye(num_palm, config.palm_channels))
        self.register_buffer("palm_scale", torch.ones(config.palm_channels))

    def fit(self, tactile_kpa: Float32[Tensor, "n 2 taxels"]) -> None:
        """Fit scales and palm axes to training touch (both hands alike)."""
        roots = root_pressure(tactile_kpa).double()
        palms = roots[..., self._num_tips :].reshape(-1, len(self.palm_basis))
        # Not centred: the mean touch is not a touch that occurs.
        basis, rms = principal_axes(palms.T @ palms / len(palms), self.palm_basis.shape[1])
        self.palm_basis.copy_(basis)
        self.palm_scale.copy_(root_scale(rms) * PALM_SCALE)
        if self._num_tips:
            tips_rms = roots[..., : self._num_tips].square().mean().sqrt()
            self.tip_scale.copy_(tips_rms.clamp_min(1e-3).float())
        self.peak_kpa.copy_(tactile_kpa.max())

    def encode(self, tactile_kpa: Pressures) -> Latents:
        """Latents; pressures below zero count as zero."""
        roots = root_pressure(tactile_kpa)
        tips = roots[..., : self._num_tips] / self.tip_scale
        palm = (roots[..., self._num_tips :] @ self.palm_basis) / self.palm_scale
        return torch.cat([tips, palm], dim=-1)[..., None, :]

    def decode(self, latents: Latents) -> Pressures:
        """Pressures in kPa, never below zero."""
        tips = latents[..., 0, : self._num_tips] * self.tip_scale
        palm = (latents[..., 0, self._num_tips :] * self.palm_scale) @ self.palm_basis.T
        return torch.cat([tips, palm], dim=-1).clamp_min(0.0).square()


def build_tokenizer(config: NetworkConfig) -> TactileTokenizer:
    """The tokenizer of a configuration; raises InvalidInputError for pads that it does not have."""
    if config.tactile_tokens == "pad" and config.tokenizer != "split_hands":
        raise InvalidInputError(
            f"network: got tactile_tokens pad with tokenizer {config.tokenizer}, expected hand; "
            "only split_hands has a token for each pad"
        )
    if config.tokenizer == "split_hands":
        return SplitHandsTokenizer(config)
    if config.tokenizer == "grid":
        return GridTokenizer(config)
    return PrincipalAxesTokenizer(config)


class TactileExpert(nn.Module):
    """Tactile stream: the tokens of each step and hand, one or one per pad; the first is clean."""

    def __init__(self, config: NetworkConfig, *, num_tokens: int, channels: int) -> None:
        super().__init__()
        width = config.tactile_width
        self._num_tokens = num_tokens
        # Rotary positions in the time of the pretrained video expert, which has them.
        self._head_width = None if config.wan is None else config.head_width
        self._add_condition = config.add_condition_to_tokens
        self._is_anchored = config.tactile_target == "residual"
        # Residuals come with the latent that they are relative to.
        self.embed = nn.Linear((1 + self._is_anchored) * channels, width)
        self.hands = nn.Parameter(0.02 * torch.randn(2, width))
        self.steps = nn.Parameter(0.02 * torch.randn(config.max_steps, 1, width))
        self.modulate = nn.Sequential(nn.SiLU(), zero_linear(width, NUM_MODULATIONS * width))
        self.modulate_out = nn.Sequential(nn.SiLU(), zero_linear(width, 2 * width))
        self.predict = zero_linear(width, channels)
        # A single token per hand needs no embedding of its pad.
        self.pads = nn.Parameter(0.02 * torch.randn(num_tokens, width)) if num_tokens > 1 else None

    def start(
        self,
        noisy: Float32[Tensor, "batch time 2 tokens channels"],
        first: Float32[Tensor, "batch 2 tokens channels"],
        condition: Condition,
    ) -> Stream:
        """Tokens of residuals (the first zero) or of plain latents (the first clean)."""
        steps, dtype = self.steps[: noisy.shape[1]], self.steps.dtype
        condition = condition.to(dtype)
        if self._is_anchored:
            noisy = torch.cat([noisy, first[:, None].expand_as(noisy)], dim=-1)
        # In this order, so that sums with one token per hand are those of older releases.
        tokens = self.embed(noisy.to(dtype)) + self.hands[:, None] + steps[:, None]
        if self._add_condition:
            tokens = tokens + condition.vector[..., None, :]
        if self.pads is not None:
            tokens = tokens + self.pads
        modulation = self._for_each_token(self.modulate(condition.vector))
        modulation = split_axis(modulation, -1, (NUM_MODULATIONS, -1))
        turn = None
        if self._head_width is not None:
            positions = tactile_positions(noisy.shape[1], 2 * self._num_tokens)
            turn = angles(positions, self._head_width).to(noisy.device)
        return Stream(
            tokens.flatten(1, 3), modulation.flatten(1, 3), turn=turn, actions=condition.actions
        )

    def finish(
        self, stream: Stream, condition: Condition
    ) -> Float32[Tensor, "batch time 2 tokens channels"]:
        """Predict the clean latents, or the velocity, as the configuration says."""
        condition = condition.to(self.steps.dtype)
        tokens = split_axis(stream.tokens, 1, (condition.vector.shape[1], 2, self._num_tokens))
        shift, scale = self._for_each_token(self.modulate_out(condition.vector)).chunk(2, dim=-1)
        return self.predict(modulated_norm(tokens, shift, scale)).float()

    def _for_each_token(
        self, of_hand: Float[Tensor, "batch time 2 width"]
    ) -> Float[Tensor, "batch time 2 tokens width"]:
        """Repeat what all tokens of a hand share."""
        return of_hand[..., None, :].expand(-1, -1, -1, self._num_tokens, -1)
