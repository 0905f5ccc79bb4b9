"""Tactile tokens of the joint model: one per hand or per pad, from any tokenizer."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dextouch.errors import InvalidInputError
from services.world_model.checkpoints import read_checkpoint, write_checkpoint
from services.world_model.network.conditioning import Condition
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import (
    JointLatents,
    JointWorldModel,
    Sampling,
    stack_noise,
)
from services.world_model.network.tactile import build_tokenizer
from services.world_model.shipped_checkpoints import paper_form_checkpoint
from services.world_model.training.joint_dataset import WindowPosition, WindowSampler
from tests.unit.world_model.conftest import losses

FORMS = [("principal_axes", "hand", 1), ("grid", "hand", 1), ("split_hands", "hand", 1),
         ("split_hands", "pad", 6)]  # fmt: skip


def _model(config, tokenizer, tokens, scale=0.1):
    """Random everywhere: zero-initialized outputs would make every test true."""
    torch.manual_seed(1)
    shape = {"tokenizer": tokenizer, "tactile_tokens": tokens, "tactile_channels": 48}
    model = JointWorldModel(config.model_copy(update=shape)).eval()
    for parameter in model.parameters():
        parameter.data.add_(scale * torch.randn(parameter.shape))
    return model


@pytest.mark.parametrize(("tokenizer", "tokens", "count"), FORMS)
def test_every_form_predicts_and_hides_noise_from_clean_tokens(
    tiny_config, toy_episodes, tokenizer, tokens, count
):
    model = _model(tiny_config, tokenizer, tokens)
    inputs = build_inputs(
        [e.cut(WindowPosition(0, 2, 9)).request for e in toy_episodes[:2]], model.config
    )
    noisy = stack_noise([model.noise(9, torch.Generator().manual_seed(s)) for s in range(2)])
    assert noisy.tactile.shape == (2, 9, 2, count, model.tokenizer.channels)
    future = model.predict(inputs, noisy)
    assert future.tactile_kpa.shape == (2, 8, 2, 320)
    assert torch.isfinite(future.tactile_kpa).all()
    mask = model.attention_mask(9)
    num_video = 3 * model.config.tokens_per_latent
    assert len(mask) == num_video + 9 * 2 * count
    clean = torch.zeros(len(mask), dtype=torch.bool)
    clean[: model.config.tokens_per_latent] = True
    clean[num_video : num_video + 2 * count] = True
    assert torch.equal(mask, ~clean[:, None] | clean[None])
    first, t = model.first_latents(inputs), torch.full((2,), 0.6)
    a = model(inputs, first, noisy, t)
    b = model(inputs, first, JointLatents(noisy.video, noisy.tactile.flip(0)), t)
    torch.testing.assert_close(a.tactile[:, 0], b.tactile[:, 0], rtol=0, atol=1e-6)
    # Every later token depends on its own noise.
    assert (a.tactile - b.tactile)[:, 1:].abs().amax((0, 4)).min() > 1e-4


def test_pads_of_equal_content_are_told_apart_by_their_embedding(tiny_config):
    expert = _model(tiny_config, "split_hands", "pad").tactile
    noisy, first = torch.ones(1, 5, 2, 6, 8), torch.ones(1, 2, 6, 8)
    condition = Condition(torch.zeros(1, 5, 2, 32))
    tokens = expert.start(noisy, first, condition).tokens.reshape(5, 2, 6, 32)
    # Tokens are in the order of step, hand and pad, each a sum with its own three embeddings.
    same = expert.embed(torch.ones(16))
    for step in range(5):
        for hand in range(2):
            for pad in range(6):
                alone = same + expert.hands[hand] + expert.steps[step, 0] + expert.pads[pad]
                torch.testing.assert_close(tokens[step, hand, pad], alone)


def test_residuals_of_pads_are_anchored_to_the_first_step(tiny_config, toy_episodes):
    model = _model(tiny_config, "split_hands", "pad", scale=0.0)
    window = toy_episodes[0].cut(WindowPosition(0, 0, 9))
    images, touch = (torch.from_numpy(a)[None] for a in (window.images, window.tactile_kpa))
    residuals = model.targets(images, touch).tactile
    assert (residuals[:, 0] == 0).all()
    for step in range(9):
        change = model.tokenizer.encode(touch[:, step]) - model.tokenizer.encode(touch[:, 0])
        torch.testing.assert_close(residuals[:, step], change, rtol=1e-4, atol=1e-5)


def test_a_hand_that_was_not_measured_costs_no_pad_anything(tiny_config, toy_episodes):
    model = _model(tiny_config, "split_hands", "pad")
    batch = WindowSampler(toy_episodes, np.random.default_rng(0), max_steps=17).draw(2, 9)
    target = model.targets(batch.images, batch.tactile_kpa)
    wrong = torch.full_like(target.tactile, 2.0)
    wrong[:, 3, 1] = 50.0
    batch.tactile_valid[:, 3, 1] = False
    model.forward = lambda *_: JointLatents(target.video, target.tactile + wrong)
    loss = losses(model, batch, generator=torch.Generator().manual_seed(0))
    assert loss.tactile.item() == pytest.approx(4.0)


def test_a_pad_that_was_not_measured_costs_nothing(tiny_config, toy_episodes):
    model = _model(tiny_config, "split_hands", "pad")
    refused = np.ones((2, 320), dtype=bool)
    # The index finger of the right hand.
    refused[1, 16:32] = False
    episodes = [replace(episode, measured_taxels=refused) for episode in toy_episodes]
    batch = WindowSampler(episodes, np.random.default_rng(0), max_steps=17).draw(2, 9)
    target = model.targets(batch.images, batch.tactile_kpa)
    wrong = torch.full_like(target.tactile, 2.0)
    wrong[:, :, 1, 1] = 50.0
    model.forward = lambda *_: JointLatents(target.video, target.tactile + wrong)
    loss = losses(model, batch, generator=torch.Generator().manual_seed(0))
    assert loss.tactile.item() == pytest.approx(4.0)


@pytest.mark.parametrize("tokenizer", ["principal_axes", "grid"])
def test_only_split_hands_has_pad_tokens(tokenizer):
    with pytest.raises(InvalidInputError, match="only split_hands has a token for each pad"):
        build_tokenizer(NetworkConfig(tokenizer=tokenizer, tactile_tokens="pad"))


def test_checkpoints_of_every_form_come_back(tiny_config, metadata, tmp_path):
    model = _model(tiny_config, "split_hands", "pad")
    stored = metadata.model_copy(update={"network": model.config})
    write_checkpoint(tmp_path / "pads.safetensors", model, stored)
    read = read_checkpoint(tmp_path / "pads.safetensors")
    assert read.metadata.network == model.config
    touch = torch.rand(3, 320)
    np.testing.assert_allclose(
        read.model.tokenizer.encode(touch), model.tokenizer.encode(touch).detach(), atol=0.02
    )


def test_the_committed_checkpoint_predicts_what_it_did_with_one_token_per_hand(toy_episode):
    """Numbers of the release before tokenizers could be chosen; another CPU rounds otherwise."""
    checkpoint = read_checkpoint(paper_form_checkpoint())
    model = checkpoint.model
    assert model.config.tokenizer == "principal_axes"
    touch = torch.linspace(-3.0, 60.0, 640).reshape(2, 320)
    roots = np.sqrt(np.maximum(touch.numpy().astype(np.float64), 0.0))
    weights = {n: t.numpy().astype(np.float64) for n, t in model.tokenizer.state_dict().items()}
    tips = roots[:, :80] / weights["tip_scale"]
    palm = roots[:, 80:] @ weights["palm_basis"] / weights["palm_scale"]
    expected = np.concatenate([tips, palm], axis=1)
    np.testing.assert_allclose(model.tokenizer.encode(touch)[:, 0], expected, rtol=1e-4, atol=1e-4)
    image = np.arange(64 * 64 * 3).reshape(64, 64, 3) % 251
    request = replace(
        toy_episode(1).cut(WindowPosition(0, 5, 17, action_kind="commanded")).request,
        first_image=image.astype(np.uint8),
        first_tactile_kpa=touch.numpy(),
    )
    inputs = build_inputs([request], model.config)
    noise = model.noise(17, torch.Generator().manual_seed(0))
    future = model.predict(inputs, noise, sampling=Sampling(2))
    steps = [0, 7, 15]
    expected_kpa = [[1314.365, 5825.875], [1246.653, 5869.729], [1262.991, 5915.386]]
    np.testing.assert_allclose(future.tactile_kpa.sum(-1)[0, steps], expected_kpa, rtol=1e-3)
    brightness = future.images.mean((0, 2, 3, 4))[steps]
    np.testing.assert_allclose(brightness, [0.567445, 0.557841, 0.563603], rtol=1e-3)
