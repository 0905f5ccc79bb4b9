"""Names of tensors in the original files and in diffusers."""

import pytest

from services.world_model.network.configuration import WanConfig
from services.world_model.network.video import empty_autoencoder, empty_transformer
from services.world_model.pretrained_video import (
    TRANSFORMER_RULES,
    autoencoder_rules,
    original_names,
)

# Read from wan/modules/model.py of Wan-Video/Wan2.2; one block.
ORIGINAL_TOP = [
    "patch_embedding.weight", "patch_embedding.bias",
    "text_embedding.0.weight", "text_embedding.0.bias",
    "text_embedding.2.weight", "text_embedding.2.bias",
    "time_embedding.0.weight", "time_embedding.0.bias",
    "time_embedding.2.weight", "time_embedding.2.bias",
    "time_projection.1.weight", "time_projection.1.bias",
    "head.modulation", "head.head.weight", "head.head.bias",
]  # fmt: skip
ORIGINAL_BLOCK = [
    "modulation", "norm3.weight", "norm3.bias",
    "ffn.0.weight", "ffn.0.bias", "ffn.2.weight", "ffn.2.bias",
    "self_attn.q.weight", "self_attn.q.bias", "self_attn.k.weight", "self_attn.k.bias",
    "self_attn.v.weight", "self_attn.v.bias", "self_attn.o.weight", "self_attn.o.bias",
    "self_attn.norm_q.weight", "self_attn.norm_k.weight",
    "cross_attn.q.weight", "cross_attn.q.bias", "cross_attn.k.weight", "cross_attn.k.bias",
    "cross_attn.v.weight", "cross_attn.v.bias", "cross_attn.o.weight", "cross_attn.o.bias",
    "cross_attn.norm_q.weight", "cross_attn.norm_k.weight",
]  # fmt: skip
# Read from wan/modules/vae2_2.py and the module definitions of diffusers.
VAE_PAIRS = {
    "conv1.weight": "quant_conv.weight",
    "conv2.bias": "post_quant_conv.bias",
    "encoder.conv1.bias": "encoder.conv_in.bias",
    "encoder.downsamples.0.downsamples.0.residual.0.gamma": (
        "encoder.down_blocks.0.resnets.0.norm1.gamma"
    ),
    "encoder.downsamples.1.downsamples.0.shortcut.weight": (
        "encoder.down_blocks.1.resnets.0.conv_shortcut.weight"
    ),
    "encoder.downsamples.1.downsamples.1.residual.6.bias": (
        "encoder.down_blocks.1.resnets.1.conv2.bias"
    ),
    "encoder.downsamples.2.downsamples.2.resample.1.weight": (
        "encoder.down_blocks.2.downsampler.resample.1.weight"
    ),
    "encoder.downsamples.2.downsamples.2.time_conv.bias": (
        "encoder.down_blocks.2.downsampler.time_conv.bias"
    ),
    "encoder.middle.0.residual.3.gamma": "encoder.mid_block.resnets.0.norm2.gamma",
    "encoder.middle.1.to_qkv.weight": "encoder.mid_block.attentions.0.to_qkv.weight",
    "encoder.middle.1.norm.gamma": "encoder.mid_block.attentions.0.norm.gamma",
    "encoder.middle.2.residual.2.weight": "encoder.mid_block.resnets.1.conv1.weight",
    "encoder.head.0.gamma": "encoder.norm_out.gamma",
    "encoder.head.2.bias": "encoder.conv_out.bias",
    "decoder.middle.1.proj.bias": "decoder.mid_block.attentions.0.proj.bias",
    "decoder.upsamples.0.upsamples.2.residual.2.weight": (
        "decoder.up_blocks.0.resnets.2.conv1.weight"
    ),
    "decoder.upsamples.0.upsamples.3.time_conv.weight": (
        "decoder.up_blocks.0.upsampler.time_conv.weight"
    ),
    "decoder.upsamples.1.upsamples.3.resample.1.bias": (
        "decoder.up_blocks.1.upsampler.resample.1.bias"
    ),
    "decoder.upsamples.3.upsamples.0.shortcut.bias": (
        "decoder.up_blocks.3.resnets.0.conv_shortcut.bias"
    ),
    "decoder.head.2.weight": "decoder.conv_out.weight",
}


@pytest.fixture(scope="module")
def full_transformer():
    return empty_transformer(WanConfig(), num_layers=30, num_heads=24, head_width=128)


def test_the_published_size_has_its_tensors_and_weights(full_transformer):
    tensors = full_transformer.state_dict()
    assert len(tensors) == 825
    assert sum(tensor.numel() for tensor in tensors.values()) == 4_999_787_712
    coder = empty_autoencoder(WanConfig()).state_dict()
    assert len(coder) == 196
    assert sum(tensor.numel() for tensor in coder.values()) == 704_688_668


def test_original_transformer_names_become_those_of_diffusers(full_transformer):
    from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers

    blocks = [f"blocks.{index}.{name}" for index in range(30) for name in ORIGINAL_BLOCK]
    original = ORIGINAL_TOP + blocks
    # diffusers' own converter tells where each tensor goes.
    told = convert_wan_transformer_to_diffusers({name: name for name in original})
    assert original_names(told, TRANSFORMER_RULES) == told
    assert set(told) == set(full_transformer.state_dict())


def test_original_autoencoder_names_become_those_of_diffusers():
    names = set(empty_autoencoder(WanConfig()).state_dict())
    assert set(VAE_PAIRS.values()) <= names
    ours = {theirs: name for name, theirs in VAE_PAIRS.items()}
    assert original_names(ours, autoencoder_rules(2)) == ours


@pytest.mark.parametrize("num_blocks", [1, 2])
def test_original_names_are_distinct(transformer, num_blocks):
    config = WanConfig(vae_width=3, vae_decoder_width=4, vae_blocks=num_blocks)
    coder = empty_autoencoder(config)
    for network, rules in (
        (transformer, TRANSFORMER_RULES),
        (coder, autoencoder_rules(num_blocks)),
    ):
        names = list(network.state_dict())
        assert len(set(original_names(names, rules).values())) == len(names)
