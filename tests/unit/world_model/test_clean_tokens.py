"""Clean tokens computed once per chunk give what masked attention over all tokens gives."""

from dataclasses import replace

import pytest
import torch

from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import Sampling, stack_noise
from tests.unit.world_model.test_options import OPTIONS, batch, model_with

__all__ = ["batch"]


def noise_of(model, count):
    return stack_noise(
        [model.noise(17, torch.Generator().manual_seed(seed)) for seed in range(count)]
    )


def assert_kept_tokens_change_nothing(model, inputs):
    """At flow times of every kind, and after several steps."""
    noisy = noise_of(model, len(inputs))
    context = model.context(inputs, model.first_latents(inputs))
    other = noise_of(model, len(inputs) + 1)
    other = type(other)(other.video[1:], other.tactile[1:])
    # Whatever is noisy while they are computed.
    for while_noisy in (noisy, other):
        clean = replace(context, clean=model.clean_tokens(context, while_noisy))
        for t in (1.0, 0.6, 1e-3):
            times = torch.full((len(inputs),), t)
            expected = model.denoise(context, noisy, times)
            got = model.denoise(clean, noisy, times)
            for a, b in ((got.video, expected.video), (got.tactile, expected.tactile)):
                torch.testing.assert_close(a, b, rtol=0, atol=1e-6 * max(1, b.abs().max()))
    futures = [
        model.predict(inputs, noisy, sampling=Sampling(4, "unipc", keep_context=keep))
        for keep in (True, False)
    ]
    torch.testing.assert_close(futures[0].images, futures[1].images, rtol=0, atol=1e-5)
    scale = max(1, futures[1].tactile_kpa.max())
    torch.testing.assert_close(
        futures[0].tactile_kpa, futures[1].tactile_kpa, rtol=0, atol=2e-6 * scale
    )


@pytest.mark.long
@pytest.mark.parametrize("options", [{}, *OPTIONS], ids=str)
def test_kept_tokens_change_nothing(tiny_config, batch, options):
    model = model_with(tiny_config, **options).requires_grad_(requires_grad=False)
    assert_kept_tokens_change_nothing(model, build_inputs(batch.requests, model.config))


def test_only_noisy_tokens_are_computed_at_every_step(tiny_config, batch):
    model = model_with(tiny_config)
    inputs, counts = build_inputs(batch.requests, model.config), []
    model.layers[1].video.to_qkv.register_forward_hook(
        lambda _, given, __: counts.append(("tokens", given[0].shape[1]))
    )
    model.tactile_condition.scene.register_forward_hook(
        lambda *_: counts.append(("scene", len(inputs)))
    )
    model.predict(inputs, noise_of(model, 2), sampling=Sampling(3))
    # An image of 32 px has four tokens; the window has four latents after the first.
    assert counts == [("scene", 2), ("tokens", 4), *[("tokens", 16)] * 3]
    counts.clear()
    model.predict(inputs, noise_of(model, 2), sampling=Sampling(1))
    assert counts == [("scene", 2), ("tokens", 20)]
