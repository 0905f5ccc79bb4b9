"""Convolutional autoencoder of pressure maps, the building block of learned tokenizers.

Layers have no biases and embeddings multiply features instead of being added, so that an untouched
map is the zero latent and the zero latent an untouched map, whatever the weights are.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from services.world_model.network.axes import split_axis


@dataclass(frozen=True)
class MapShape:
    """Shape of the maps that one autoencoder handles, and its size.

    Args:
        rows: rows of a map.
        columns: columns of a map.
        num_maps: maps per hand that share the weights and differ by an identity embedding.
        channels: latent values of each map.
        width: channels of the convolutions.
        hidden: width of the layer between features and latents.
        num_halvings: how often the encoder halves the resolution.
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
        strides = [2] * shape.num_halvings or [1]
        self.deeper = nn.Sequential(
            *(
                layer
                for stride in strides
                for layer in (_convolution(shape.width, shape.width, stride=stride), nn.GELU())
            ),
            nn.Flatten(),
            nn.Linear(shape.num_features, shape.hidden, bias=False),
        )
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
        self.deeper = nn.Sequential(
            nn.GELU(),
            *(
                layer
                for _ in range(shape.num_halvings - 1)
                for layer in (
                    nn.Upsample(scale_factor=2),
                    _convolution(shape.width, shape.width),
                    nn.GELU(),
                )
            ),
        )
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
