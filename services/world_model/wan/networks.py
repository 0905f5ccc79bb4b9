"""The Wan2.2 networks of diffusers without memory for their weights, which come from files."""

from typing import TYPE_CHECKING

import torch

from services.world_model.wan.configuration import WanConfig, dtype_of

if TYPE_CHECKING:
    from diffusers import AutoencoderKLWan, WanTransformer3DModel


def empty_transformer(
    config: WanConfig, *, num_layers: int, num_heads: int, head_width: int
) -> "WanTransformer3DModel":
    """Transformer on the meta device, in the precision of the configuration."""
    from diffusers import WanTransformer3DModel

    sizes = config.transformer_sizes(
        num_layers=num_layers, num_heads=num_heads, head_width=head_width
    )
    with torch.device("meta"):
        transformer = WanTransformer3DModel(**sizes)
    for name, parameter in transformer.named_parameters():
        parameter.data = parameter.data.to(dtype_of(name, config.dtype))
    return transformer.eval()


def empty_autoencoder(config: WanConfig) -> "AutoencoderKLWan":
    """Video autoencoder on the meta device; always float32, as it is published."""
    from diffusers import AutoencoderKLWan

    with torch.device("meta"):
        autoencoder = AutoencoderKLWan(**config.autoencoder_sizes())
    return autoencoder.eval()
