"""Split-Hands tokenizer of the paper: fingertips and palm apart, by their physical topology.

All ten fingertips share one encoder and both palms another. An identity embedding tells the pads
apart, and an embedding of the position the taxels of a pad. A hand is one token per pad
(`tactile_tokens` "pad", as in the paper) or all of them in one token ("hand", several times
cheaper in the world model); the weights are the same.
"""

import torch
from jaxtyping import Float32
from torch import Tensor

from dextouch.tactile.layout import NUM_FINGERTIPS, NUM_TIP_TAXELS, PALM_SHAPE, TIP_SHAPE
from services.world_model.network.axes import split_axis
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.learned_tokenizer import NUM_PADS, LearnedTokenizer
from services.world_model.network.pad_autoencoder import MapDecoder, MapEncoder, MapShape


class SplitHandsTokenizer(LearnedTokenizer):
    """One autoencoder for fingertips, one for palms."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        channels = config.tactile_channels // NUM_PADS
        tip = MapShape(
            *TIP_SHAPE, num_maps=NUM_FINGERTIPS, channels=channels, width=16, hidden=64,
            num_halvings=0,
        )  # fmt: skip
        palm = MapShape(
            *PALM_SHAPE, num_maps=1, channels=channels, width=24, hidden=128, num_halvings=2
        )
        self.tip_encoder, self.tip_decoder = MapEncoder(tip), MapDecoder(tip)
        self.palm_encoder, self.palm_decoder = MapEncoder(palm), MapDecoder(palm)

    def encode_roots(self, roots: Float32[Tensor, "n 320"]) -> Float32[Tensor, "n latents"]:
        """Latents of the five fingertips, then of the palm."""
        tips = split_axis(roots[:, :NUM_TIP_TAXELS], 1, (NUM_FINGERTIPS, *TIP_SHAPE))
        palm = split_axis(roots[:, NUM_TIP_TAXELS:], 1, (1, *PALM_SHAPE))
        return torch.cat([self.tip_encoder(tips), self.palm_encoder(palm)], dim=1).flatten(1)

    def decode_roots(self, latents: Float32[Tensor, "n latents"]) -> Float32[Tensor, "n 320"]:
        """Root pressures of the five fingertips, then of the palm."""
        pads = split_axis(latents, 1, (NUM_PADS, -1))
        tips = self.tip_decoder(pads[:, :NUM_FINGERTIPS]).flatten(1)
        return torch.cat([tips, self.palm_decoder(pads[:, NUM_FINGERTIPS:]).flatten(1)], dim=1)
