"""Closed-form codecs: exact with all their channels, repeatable, and bounded at the extremes."""

import numpy as np
import pytest
import torch

from services.world_model.dynamics.features import principal_axes, root_scale
from services.world_model.network.codecs import VisualCodec, to_uint8, to_unit
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.tactile import PrincipalAxesTokenizer


def _images(num_windows=6, num_steps=9, px=32):
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(num_windows, num_steps, px // 8, px // 8, 3, generator=generator)
    fine = coarse.repeat_interleave(8, 2).repeat_interleave(8, 3)
    return to_uint8(0.8 * fine + 0.2 * torch.rand(fine.shape, generator=generator))


def test_images_come_back_exactly_with_all_channels():
    codec = VisualCodec(NetworkConfig(image_px=32, codec_channels=768))
    images = _images()
    # White noise has all axes; scaling by roots must not cost precision.
    codec.fit(images)
    back = codec.decode(codec.encode(to_unit(images)))
    assert torch.equal(to_uint8(back), images)


def test_fewer_channels_lose_the_least_and_lose_it_gradually():
    images = _images()
    errors = []
    for channels in (4, 16, 64):
        codec = VisualCodec(NetworkConfig(image_px=32, codec_channels=channels))
        codec.fit(images)
        back = codec.decode(codec.encode(to_unit(images)))
        errors.append(float((back - to_unit(images)).square().mean()))
    assert errors[0] > 1.05 * errors[1] > 1.05 * errors[2]


def test_latents_are_causal_groups_of_one_and_four():
    codec = VisualCodec(NetworkConfig(image_px=32, codec_channels=16))
    images = _images()
    codec.fit(images)
    latents = codec.encode(to_unit(images))
    assert latents.shape == (6, 3, 4, 64)
    changed = images.clone()
    changed[:, 5:] = 0
    assert torch.equal(codec.encode(to_unit(changed))[:, :2], latents[:, :2])
    # The first image alone gives the first latent: what the server computes.
    np.testing.assert_allclose(codec.encode(to_unit(images[:, :1]))[:, 0], latents[:, 0], atol=1e-6)


def test_a_token_holds_its_own_part_of_the_image():
    codec = VisualCodec(NetworkConfig(image_px=32, codec_channels=16))
    images = _images()
    codec.fit(images)
    changed = images.clone()
    changed[:, :, :16, 16:] = 255
    moved = (codec.encode(to_unit(changed)) - codec.encode(to_unit(images))).abs().amax((0, 1, 3))
    assert moved[1] > 0.01
    assert moved[[0, 2, 3]].max() == 0


def test_the_same_data_give_the_same_signs():
    moment = torch.randn(30, 12, generator=torch.Generator().manual_seed(3)).double()
    basis, rms = principal_axes(moment.T @ moment, 5)
    flipped, _ = principal_axes((-moment).T @ (-moment), 5)
    assert torch.equal(basis, flipped)
    assert (basis.gather(0, basis.abs().argmax(0, keepdim=True)) > 0).all()
    np.testing.assert_allclose(basis.T @ basis, np.eye(5), atol=1e-6)
    assert (rms[:-1] >= rms[1:]).all()


@pytest.mark.parametrize("seed", [9, 31, 44])
def test_hands_that_touch_with_few_taxels_have_axes(seed):
    """Matrices for which `torch.linalg.eigh` of torch 2.13 with MKL does not converge."""
    taxels = np.r_[
        0:27, 28:31, 32:43, 45:47, 48:56, 57:59, 61:63, 64:68, 69:72, 73:75, 77:79, 90:93, 108:111,
        127, 271, 287, 302:304, 318:320,
    ]  # fmt: skip
    rng = np.random.default_rng(seed)
    num_touching = [30, 59, 79, 120][seed % 4]
    roots = np.zeros((400, 320))
    roots[:, taxels] = np.sqrt(rng.gamma(0.3, 20, (400, len(taxels))))
    roots *= rng.random((400, 1)) < num_touching / 400
    moment = roots.T @ roots / 400
    basis, rms = principal_axes(torch.from_numpy(moment), 96)
    # What 79 taxels feel is within the first 96 axes.
    back = (basis * rms.square()) @ basis.T
    np.testing.assert_allclose(back.numpy(), moment, atol=1e-4 * moment.max())


def test_scales_stay_finite_without_any_signal():
    assert torch.isfinite(root_scale(torch.zeros(4))).all()
    assert (root_scale(torch.zeros(4)) > 0).all()


@pytest.fixture
def tokenizer():
    tokenizer = PrincipalAxesTokenizer(NetworkConfig(palm_channels=240))
    touch = 30 * torch.rand(64, 2, 320, generator=torch.Generator().manual_seed(1))
    tokenizer.fit(touch * (touch > 15))
    return tokenizer


def test_touch_comes_back_exactly_with_all_channels(tokenizer):
    touch = 50 * torch.rand(5, 17, 2, 320, generator=torch.Generator().manual_seed(2))
    np.testing.assert_allclose(tokenizer.decode(tokenizer.encode(touch)), touch, rtol=1e-3)


@pytest.mark.parametrize("pressure_kpa", [0.0, 1e-12, 1e-3, 40.0, 1e5])
def test_silent_and_saturated_touch_survive(tokenizer, pressure_kpa):
    touch = torch.full((1, 320), pressure_kpa)
    latent = tokenizer.encode(touch)
    assert torch.isfinite(latent).all()
    np.testing.assert_allclose(tokenizer.decode(latent), touch, rtol=1e-3, atol=1e-9)


def test_no_touch_is_the_zero_latent_and_suction_counts_as_none(tokenizer):
    assert (tokenizer.encode(torch.zeros(3, 320)) == 0).all()
    assert (tokenizer.encode(torch.full((3, 320), -2.0)) == 0).all()
    assert (tokenizer.decode(torch.full((3, 1, 320), -9.0)) >= 0).all()


def test_all_tips_share_one_encoder(tokenizer):
    touch = torch.zeros(5, 320)
    for finger in range(5):
        touch[finger, 16 * finger : 16 * (finger + 1)] = torch.arange(16.0)
    latents = tokenizer.encode(touch)
    for finger in range(5):
        own = latents[finger, 0, 16 * finger : 16 * (finger + 1)]
        assert torch.equal(own, latents[0, 0, :16])


def test_a_glove_that_never_felt_anything_can_be_fitted():
    tokenizer = PrincipalAxesTokenizer(NetworkConfig())
    tokenizer.fit(torch.zeros(8, 2, 320))
    assert torch.isfinite(tokenizer.encode(torch.ones(2, 320))).all()


def test_latents_below_zero_are_no_pressure(tiny_config):
    tokenizer = PrincipalAxesTokenizer(tiny_config)
    latents = torch.zeros(2, 1, tokenizer.channels)
    latents[0, 0, :80] = -3.0
    latents[1, 0, 80:] = -3.0
    assert tokenizer.decode(latents).abs().max() == 0.0
