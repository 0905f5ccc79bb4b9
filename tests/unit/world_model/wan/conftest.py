"""Tiny Wan2.2 networks with random weights: every part of the full size, small enough for tests."""

from dataclasses import replace

import pytest
import torch

from services.world_model.network.configuration import NetworkConfig, WanConfig

LAYERS, HEADS, HEAD_WIDTH = 2, 2, 12


@pytest.fixture(scope="session")
def wan_config():
    return WanConfig(
        ffn_width=32, time_width=16, text_width=32, text_tokens=12, vae_width=3,
        vae_decoder_width=4, vae_blocks=1, precision="float32",
    )  # fmt: skip


@pytest.fixture(scope="session")
def transformer(wan_config):
    """Random everywhere; diffusers starts biases and norms at zero and one."""
    from diffusers import WanTransformer3DModel  # seconds, in every process that collects tests

    sizes = wan_config.transformer_sizes(num_layers=LAYERS, num_heads=HEADS, head_width=HEAD_WIDTH)
    return shaken(WanTransformer3DModel(**sizes), seed=0)


@pytest.fixture(scope="session")
def autoencoder(wan_config):
    from diffusers import AutoencoderKLWan

    return shaken(AutoencoderKLWan(**wan_config.autoencoder_sizes()), seed=1)


def shaken(network, seed):
    torch.manual_seed(seed)
    network.eval().requires_grad_(requires_grad=False)
    for parameter in network.parameters():
        parameter.add_(0.1 * torch.randn(parameter.shape))
    return network


@pytest.fixture(scope="session")
def full_config(wan_config):
    """The architecture of the full size, tiny."""
    return NetworkConfig(
        video_expert="wan", wan=wan_config, image_px=64, patch_px=16, codec_channels=48,
        video_width=HEADS * HEAD_WIDTH, num_heads=HEADS, head_width=HEAD_WIDTH, num_layers=LAYERS,
        tactile_width=16, ffn_ratio=2, use_pose_raster=False, add_condition_to_tokens=False,
        prediction="velocity", video_target="plain",
    )  # fmt: skip


@pytest.fixture(scope="session")
def text_encoder(wan_config):
    from transformers import UMT5Config, UMT5EncoderModel

    torch.manual_seed(2)
    sizes = UMT5Config(
        vocab_size=32, d_model=wan_config.text_width, d_kv=8, d_ff=16, num_layers=2, num_heads=4,
        dropout_rate=0.0,
    )  # fmt: skip
    return UMT5EncoderModel(sizes).eval().requires_grad_(requires_grad=False)


@pytest.fixture(scope="session")
def pretrained_folder(tmp_path_factory, transformer, autoencoder, text_encoder):
    """A folder in the layout of the published model, written by the libraries themselves."""
    folder = tmp_path_factory.mktemp("pretrained")
    transformer.save_pretrained(folder / "transformer")
    autoencoder.save_pretrained(folder / "vae")
    text_encoder.save_pretrained(folder / "text_encoder")
    save_tokenizer(folder / "tokenizer")
    return folder


def save_tokenizer(folder):
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace
    from tokenizers.processors import TemplateProcessing
    from transformers import PreTrainedTokenizerFast

    marks = {"pad_token": "<pad>", "eos_token": "</s>", "unk_token": "<unk>"}
    words = [*marks.values(), "push", "the", "box", "with", "both", "hands", "stand"]
    numbers = {word: number for number, word in enumerate(words)}
    tokenizer = Tokenizer(WordLevel(numbers, unk_token=marks["unk_token"]))
    tokenizer.pre_tokenizer = Whitespace()
    tokenizer.post_processor = TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, **marks).save_pretrained(folder)


def enlarged(episode):
    """The toy episode with images of 64 pixels, the least of four tokens per latent frame."""
    K_head = episode.K_head.copy()
    K_head[:2] *= 2
    images = episode.images.repeat(2, axis=1).repeat(2, axis=2)
    return replace(episode, images=images, K_head=K_head)


@pytest.fixture
def large_episode(toy_episode):
    return lambda seed: enlarged(toy_episode(seed))
