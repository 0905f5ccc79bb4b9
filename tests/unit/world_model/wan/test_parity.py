"""The full-size video expert equals the transformer of diffusers, and its codec the autoencoder."""

import copy
from dataclasses import replace

import pytest
import torch

from services.world_model.network.attention import (
    ExpertBlock,
    JointLayer,
    Stream,
    Text,
    angles,
    rotate,
    tactile_positions,
    video_positions,
)
from services.world_model.network.codecs import WanVideoCodec
from services.world_model.network.configuration import LATENT_MEAN, LATENT_STD
from services.world_model.network.video import (
    WanBlock,
    WanVideoCondition,
    WanVideoExpert,
)

NO_PAST = torch.zeros(2, 0, 2, 8, 8)


@pytest.fixture
def latents():
    """[batch, channels, latents, rows, columns] of 64 px images and 9 steps."""
    return torch.randn(2, 48, 3, 4, 4, generator=torch.Generator().manual_seed(2))


@pytest.fixture
def text():
    return torch.randn(2, 12, 32, generator=torch.Generator().manual_seed(3))


def tokens_of(latents):
    """Two by two latents as one token, written as loops."""
    batch, channels, frames, rows, columns = latents.shape
    tokens = torch.empty(batch, frames, rows // 2 * columns // 2, 4 * channels)
    for row in range(0, rows, 2):
        for column in range(0, columns, 2):
            parts = [latents[:, :, :, row + i, column + j] for i in (0, 1) for j in (0, 1)]
            place = row // 2 * columns // 2 + column // 2
            tokens[:, :, place] = torch.cat(parts, dim=1).transpose(1, 2)
    return tokens


def velocity(config, transformer, latents, t, text):
    """What the joint layers predict without tactile tokens, actions and mask."""
    condition = WanVideoCondition(config, config.wan, transformer.condition_embedder)
    expert = WanVideoExpert(config, transformer)
    tokens = tokens_of(latents)
    conditions = condition.at(condition.of(torch.zeros(*t.shape, config.video_width), text), t)
    stream = expert.start(tokens, tokens[:, 0], conditions, torch.zeros(2, 9, 2, 8, 8), NO_PAST)
    width = config.tactile_width
    nothing = Stream(torch.zeros(2, 0, width), torch.zeros(2, 0, 6, width))
    everything = torch.ones(stream.tokens.shape[1], stream.tokens.shape[1], dtype=torch.bool)
    for block in transformer.blocks:
        layer = JointLayer(WanBlock(block), ExpertBlock(config, config.tactile_width))
        stream, nothing = layer(stream, nothing, everything)
    return expert.finish(stream, conditions)


def relative_error(got, expected):
    return ((got - expected).norm() / expected.norm()).item()


@pytest.mark.long
def test_each_latent_with_its_own_time_equals_times_per_token(
    full_config, transformer, latents, text
):
    t = torch.tensor([[0.0, 0.3, 0.9], [0.0, 1.0, 0.5]])
    with torch.no_grad():
        ours = velocity(full_config, transformer, latents, t, text)
        per_token = 1000.0 * t.repeat_interleave(4, dim=1)
        theirs = transformer(latents, per_token, text).sample
    assert relative_error(ours, tokens_of(theirs)) <= 1e-5


def test_one_time_for_all_latents_equals_a_scalar_time(full_config, transformer, latents, text):
    t = torch.tensor([0.25, 0.8])
    with torch.no_grad():
        ours = velocity(full_config, transformer, latents, t[:, None].expand(-1, 3), text)
        theirs = transformer(latents, 1000.0 * t, text).sample
    assert relative_error(ours, tokens_of(theirs)) <= 1e-5


def test_half_precision_is_as_near_as_that_of_diffusers(full_config, transformer, latents, text):
    half = copy.deepcopy(transformer).to(torch.bfloat16)
    for name, parameter in half.named_parameters():
        if any(part in name for part in ("time_embedder", "scale_shift_table", "norm2")):
            parameter.data = transformer.get_parameter(name).data.clone()
    t = torch.tensor([[0.0, 0.3, 0.9], [0.0, 1.0, 0.5]])
    per_token = 1000.0 * t.repeat_interleave(4, dim=1)
    with torch.no_grad():
        exact = tokens_of(transformer(latents, per_token, text).sample)
        ours = velocity(full_config, half, latents, t, text.bfloat16())
        theirs = half(latents.bfloat16(), per_token, text.bfloat16()).sample.float()
    assert relative_error(ours, exact) <= 1.5 * relative_error(tokens_of(theirs), exact) <= 0.05


def test_an_action_moves_its_own_latent_before_attention_spreads_it(
    full_config, transformer, latents, text
):
    condition = WanVideoCondition(full_config, full_config.wan, transformer.condition_embedder)
    t = torch.full((2, 3), 0.5)
    actions = torch.zeros(2, 3, full_config.video_width)
    before = condition.at(condition.of(actions, text), t)
    actions[:, 1] += 0.1
    after = condition.at(condition.of(actions, text), t)
    moved = (after.modulation - before.modulation).abs().amax((0, 2, 3))
    assert moved[1] > 1e-3
    assert moved[[0, 2]].max() == 0.0


def test_rotary_positions_are_those_of_diffusers(transformer):
    ours = angles(video_positions(3, 2), 12)
    cos, sin = transformer.rope(torch.zeros(1, 48, 3, 4, 4))
    torch.testing.assert_close(ours.cos(), cos[0, :, 0, 0::2], rtol=0, atol=1e-6)
    torch.testing.assert_close(ours.sin(), sin[0, :, 0, 1::2], rtol=0, atol=1e-6)


def test_attention_between_touch_and_video_depends_on_their_distance_in_time():
    video, tactile = video_positions(4, 2), tactile_positions(13, 2)
    # Step 8 ends latent 2: both tokens of the step and the first token of that latent.
    assert torch.equal(tactile[16], video[2 * 4])
    heads = torch.randn(1, 1, 2, 24, generator=torch.Generator().manual_seed(4))
    query, key = heads[:, :, :1], heads[:, :, 1:]

    def logit(step, latent):
        at = angles(tactile[2 * step, None], 24), angles(video[4 * latent, None], 24)
        return (rotate(query, at[0]) * rotate(key, at[1])).sum().item()

    assert logit(8, 1) == pytest.approx(logit(12, 2), abs=1e-5)
    assert abs(logit(8, 1) - logit(8, 2)) > 1e-3


@pytest.fixture
def codec(full_config, autoencoder):
    codec = WanVideoCodec(full_config.wan)
    codec.autoencoder = autoencoder
    return codec


@pytest.mark.parametrize("num_steps", [1, 9])
def test_the_codec_equals_the_autoencoder_called_directly(codec, autoencoder, num_steps):
    images = torch.rand(2, num_steps, 64, 64, 3, generator=torch.Generator().manual_seed(5))
    pixels = torch.stack([images[..., c] for c in range(3)], dim=1) * 2 - 1
    with torch.no_grad():
        # One by one, as rounding depends on the number of videos.
        mean = torch.cat([autoencoder.encode(one).latent_dist.mean for one in pixels.split(1)])
    shift, scale = (torch.tensor(v)[None, :, None, None, None] for v in (LATENT_MEAN, LATENT_STD))
    expected = tokens_of((mean - shift) / scale)
    tokens = codec.encode(images)
    assert torch.equal(tokens, expected)
    with torch.no_grad():
        decoded = autoencoder.decode((mean - shift) / scale * scale + shift).sample
    theirs = torch.stack([(decoded[:, c] + 1) / 2 for c in range(3)], dim=-1)
    torch.testing.assert_close(codec.decode(tokens), theirs, rtol=0, atol=1e-6)
    assert decoded.abs().max() <= 1.0


def test_the_codec_is_causal(codec):
    images = torch.rand(1, 9, 64, 64, 3, generator=torch.Generator().manual_seed(6))
    tokens = codec.encode(images)
    assert torch.equal(codec.encode(images[:, :5]), tokens[:, :2])
    all_images = codec.decode(tokens)
    assert torch.equal(codec.decode(tokens[:, :2]), all_images[:, :5])
    assert torch.equal(codec.decode_future(tokens, all_images=True), all_images[:, 1:])
    assert torch.equal(codec.decode_future(tokens, all_images=False), all_images[:, -1:])


def test_a_stream_without_positions_is_not_turned(full_config, transformer, latents):
    block = WanBlock(transformer.blocks[0])
    tokens = torch.randn(1, 12, 24, generator=torch.Generator().manual_seed(7))
    plain = Stream(tokens, torch.zeros(1, 3, 6, 24))
    turned = Stream(tokens, plain.modulation, turn=angles(torch.zeros(12, 3), 12))
    for a, b in zip(
        block.queries_keys_values(plain), block.queries_keys_values(turned), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-6)


def test_the_keys_of_a_text_are_computed_once_for_all_steps(transformer):
    block = WanBlock(transformer.blocks[0])
    tokens = torch.randn(2, 12, 24, generator=torch.Generator().manual_seed(8))
    words = Text(torch.randn(2, 12, 24, generator=torch.Generator().manual_seed(9)))
    stream = Stream(tokens, torch.zeros(2, 3, 6, 24), text=words)
    with torch.no_grad():
        first = block.finish(stream, tokens)
        again = block.finish(stream, tokens)
        fresh = block.finish(replace(stream, text=Text(words.words)), tokens)
    assert len(words.kept) == 1
    assert torch.equal(first.tokens, again.tokens)
    assert torch.equal(first.tokens, fresh.tokens)
