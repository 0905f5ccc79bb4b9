"""The last images alone, from a few latents or in tiles: equal to, or near, diffusers' decoder."""

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from dextouch.errors import InvalidInputError
from services.world_model.network.codecs import WanVideoCodec, last_images
from services.world_model.network.configuration import SPATIAL_FACTOR, NetworkConfig, WanConfig
from services.world_model.plan import plan_of
from services.world_model.settings import Placement
from services.world_model.shipped_checkpoints import paper_form_checkpoint
from services.world_model.world import open_world
from tests.unit.world_model.wan.conftest import shaken


def full_size():
    """The shape of the preset wan22-5b, at four sampler steps."""
    return NetworkConfig(
        video_expert="wan", wan=WanConfig(), image_px=256, patch_px=16, codec_channels=48,
        video_width=3072, num_heads=24, head_width=128, num_layers=30, tactile_width=512,
        ffn_ratio=4, use_pose_raster=False, prediction="velocity", video_target="plain",
        sampling_steps=4,
    )  # fmt: skip


def latents_of(count, side=4):
    generator = torch.Generator().manual_seed(count)
    return 0.3 * torch.randn(2, 48, count, side, side, generator=generator)


@pytest.fixture(scope="module", params=[1, 2], ids="{} blocks".format)
def decoder(request, wan_config):
    """With one block fewer or as many as the published one has; images that are not clipped."""
    from diffusers import AutoencoderKLWan

    sizes = {**wan_config.autoencoder_sizes(), "num_res_blocks": request.param}
    return shaken(AutoencoderKLWan(**sizes), seed=1)


@pytest.mark.parametrize("num_latents", [1, 2, 3, 5])
def test_the_last_images_are_those_of_the_whole_video(decoder, num_latents):
    latents = latents_of(num_latents)
    whole = decoder.decode(latents).sample
    assert whole.abs().median() < 0.9
    for num in {1, min(4, whole.shape[2]), min(6, whole.shape[2]), whole.shape[2]}:
        got = last_images(decoder, latents, num)
        torch.testing.assert_close(got, whole[:, :, -num:], rtol=0, atol=1e-6)


def test_frames_that_no_image_depends_on_are_not_computed(decoder):
    frames = {}
    convolutions = [
        *[c for block in decoder.decoder.up_blocks[-1].resnets for c in (block.conv1, block.conv2)],
        decoder.decoder.conv_out,
    ]
    hooks = [
        one.register_forward_hook(
            lambda module, _, out: frames.update({module: frames.get(module, 0) + out.shape[2]})
        )
        for one in convolutions
    ]
    last_images(decoder, latents_of(5), 1)
    for hook in hooks:
        hook.remove()
    # Backwards from the one image: two frames more for every convolution after it, of 17.
    assert [frames[one] for one in reversed(convolutions)] == [
        1 + 2 * after for after in range(len(convolutions))
    ]


def test_before_the_last_block_the_last_image_depends_on_every_frame(decoder):
    """So that no exact decoding does without them: gradients of diffusers' own decoder."""
    given = {block: [] for block in decoder.decoder.up_blocks}
    hooks = [
        block.register_forward_pre_hook(lambda block, args: given[block].append(args[0]))
        for block in given
    ]
    latents = latents_of(5).requires_grad_()
    last = decoder.decode(latents).sample[:, :, -1].sum()
    for hook in hooks:
        hook.remove()

    def needed(parts):
        found = torch.autograd.grad(last, parts, retain_graph=True, materialize_grads=True)
        return torch.cat(found, dim=2).abs().amax((0, 1, 3, 4)) > 0

    assert needed([latents]).all()
    *early, late = given.values()
    assert [len(needed(parts)) for parts in given.values()] == [5, 9, 17, 17]
    assert all(needed(parts).all() for parts in early)
    # Two for each convolution of three frames after it.
    assert needed(late).sum() == 1 + 2 * (2 * len(decoder.decoder.up_blocks[-1].resnets) + 1)


def test_a_window_decodes_the_latest_latents_as_a_video_of_their_own(wan_config, autoencoder):
    codec = WanVideoCodec(wan_config)
    codec.autoencoder = autoencoder
    tokens = torch.randn(1, 5, 4, 4 * 48, generator=torch.Generator().manual_seed(0))
    whole = codec.decode(tokens)
    torch.testing.assert_close(codec.decode_future(tokens, all_images=True), whole[:, 1:])
    codec.window = 2
    everything = codec.decode_future(tokens, all_images=True)
    assert everything.shape == whole[:, 1:].shape
    for latent in range(1, 5):
        alone = codec.decode(tokens[:, latent - 1 : latent + 1])[:, 1:]
        torch.testing.assert_close(everything[:, 4 * latent - 4 : 4 * latent], alone)
    last = codec.decode_future(tokens, all_images=False)
    torch.testing.assert_close(last, everything[:, -1:], rtol=0, atol=1e-6)
    assert not torch.allclose(last, whole[:, -1:], atol=1e-4)


def test_tiles_are_blended_without_seams(wan_config, autoencoder):
    codec = WanVideoCodec(wan_config)
    codec.autoencoder = autoencoder
    latents = latents_of(2, side=12)
    whole = codec._decoded(latents, 4)
    codec.tile_px = 12 * SPATIAL_FACTOR
    assert torch.equal(codec._decoded(latents, 4), whole)
    codec.tile_px = 8 * SPATIAL_FACTOR
    tiled = codec._decoded(latents, 4)
    off = tiled - whole
    # Random networks look at all of an image: more than half of it was measured with others.
    assert 0 < off.square().mean().sqrt() < 0.6 * whole.std()
    # A seam would be a jump of the error between neighbouring columns where a tile begins or ends.
    jumps = (off[..., 1:] - off[..., :-1]).square().mean((0, 1, 2, 3)).sqrt()
    edges = [6 * SPATIAL_FACTOR - 1, 8 * SPATIAL_FACTOR - 1]
    assert jumps[edges].max() < 3 * jumps.median()


def test_options_of_decoding_are_for_the_full_size():
    with pytest.raises(InvalidInputError, match="decode-window"):
        open_world(paper_form_checkpoint(), placement=Placement(decode_window=2))


@pytest.mark.slow
def test_what_the_full_size_saves():
    """Counted by torch on the meta device, in TFLOP: 4 steps, of which a chunk took 31.6."""
    work = {one.name: one for one in plan_of(full_size()).work}
    others = sum(o.times * o.flops for name, o in work.items() if "decode" not in name)
    before = work["decode all images"].flops + others
    assert before / 1e12 == pytest.approx(31.56, abs=0.01)
    assert work["decode the last image"].flops / work["decode all images"].flops < 0.84
    with torch.device("meta"), torch.no_grad(), FlopCounterMode(display=False) as counter:
        last_images(WanVideoCodec(WanConfig()).autoencoder, torch.zeros(1, 48, 2, 16, 16), 1)
    assert (counter.get_total_flops() + others) / before < 0.55
