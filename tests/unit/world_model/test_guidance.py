"""Classifier-free guidance, and the dropout of instructions and actions that it is trained with."""

import pytest
import torch

from dextouch.errors import InvalidInputError
from services.world_model.checkpoints import Checkpoint, dropout_shares, write_checkpoint
from services.world_model.command_line import open_by_digest
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import Sampling
from services.world_model.settings import Placement, WorldModelSettings
from services.world_model.shipped_checkpoints import paper_form_checkpoint
from services.world_model.training.joint_objective import LossOptions
from services.world_model.world import open_world
from tests.unit.world_model.conftest import losses
from tests.unit.world_model.test_clean_tokens import noise_of
from tests.unit.world_model.test_options import batch, model_with

__all__ = ["batch"]
CONDITIONS = (
    {},
    {"action_conditioning": "cross_attention"},
    {"use_contact_geometry": True, "instruction_encoder": "subwords"},
)


def sampled(model, inputs, first, steps, guidance):
    noise = noise_of(model, 2)
    return model.sample(inputs, first, noise, Sampling(steps, guidance=guidance))


@pytest.mark.parametrize("options", CONDITIONS, ids=str)
def test_guidance_moves_away_from_what_neither_text_nor_actions_say(tiny_config, batch, options):
    model = model_with(tiny_config, **options).requires_grad_(requires_grad=False)
    inputs = build_inputs(batch.requests, model.config)
    both = torch.ones(2, dtype=torch.bool)
    first = model.first_latents(inputs)
    told = sampled(model, inputs, first, 1, 1.0)
    free = sampled(model, inputs.without(both, both), first, 1, 1.0)
    twice = type(first)(*(torch.cat([one, one]) for one in vars(first).values()))
    got = sampled(model, inputs.joined(inputs.without(both, both)), twice, 1, 2.5)
    for name in ("video", "tactile"):
        a, b = getattr(told, name), getattr(free, name)
        assert not torch.allclose(a[:, 1:], b[:, 1:])
        expected = b + 2.5 * (a - b)
        torch.testing.assert_close(
            getattr(got, name), expected, rtol=0, atol=1e-5 * max(1, expected.abs().max())
        )


def test_a_scale_of_one_is_no_guidance(tiny_config, batch):
    model = model_with(tiny_config).requires_grad_(requires_grad=False)
    inputs = build_inputs(batch.requests, model.config)
    noise = noise_of(model, 2)
    plain, one, more = (
        model.predict(inputs, noise, sampling=sampling)
        for sampling in (Sampling(3), Sampling(3, guidance=1.0), Sampling(3, guidance=3.0))
    )
    assert torch.equal(one.images, plain.images)
    assert torch.equal(one.tactile_kpa, plain.tactile_kpa)
    assert more.images.shape == plain.images.shape
    assert not torch.allclose(more.tactile_kpa, plain.tactile_kpa)


@pytest.mark.parametrize("options", CONDITIONS, ids=str)
def test_dropped_windows_learn_nothing_of_what_is_dropped(tiny_config, batch, options):
    model = model_with(tiny_config, **options)
    conditions = (model.video_condition, model.tactile_condition)

    def learned(text, actions):
        model.zero_grad()
        chosen = LossOptions(text_dropout=text, action_dropout=actions)
        loss = losses(model, batch, generator=torch.Generator().manual_seed(0), options=chosen)
        (loss.video + loss.tactile).backward()
        of_actions = [*conditions[0].actions_weights(), *conditions[1].actions_weights()]
        of_text = [one.static.instruction.table.weight for one in conditions]
        return (
            any(bool(one.grad.any()) for one in of_text if one.grad is not None),
            any(bool(one.grad.any()) for one in of_actions if one.grad is not None),
        )

    for one in conditions:
        network = one.actions if one.actions is not None else one.action_tokens.parts
        one.actions_weights = network.parameters
    assert learned(0.0, 0.0) == (True, True)
    assert learned(1.0, 0.0) == (False, True)
    assert learned(0.0, 1.0) == (True, False)
    assert learned(1.0, 1.0) == (False, False)


def test_shares_of_dropped_windows_are_nested(tiny_config, batch):
    inputs = build_inputs([*batch.requests] * 50, tiny_config)
    drawn = torch.rand(len(inputs), generator=torch.Generator().manual_seed(0))
    without = inputs.without(drawn < 0.2, drawn < 0.1)
    silent = torch.tensor([text == "" for text in without.instructions])
    assert torch.equal(silent, (without.words == 0).all(dim=1))
    assert torch.equal(without.acting == 0, drawn < 0.1)
    assert bool(silent[without.acting == 0].all())
    # What is known before any action stays.
    assert torch.equal(without.raster[:, 0], inputs.raster[:, 0])
    assert not without.raster[without.acting == 0, 1:].any()


def test_guidance_of_a_model_that_was_not_trained_for_it_is_refused():
    with pytest.raises(InvalidInputError, match=r"windows\.text-dropout"):
        open_world(paper_form_checkpoint(), sampling=Sampling(guidance=2.0))


@pytest.mark.parametrize("shares", [(0.0, 0.1), (0.1, 0.0), (0.2, 0.1)])
def test_both_shares_of_dropped_windows_are_needed(tiny_model, metadata, tmp_path, shares):
    path = tmp_path / "model.safetensors"
    both = dict(zip(("text_dropout", "action_dropout"), shares, strict=True))
    # The flag alone says nothing: it may be zero, or of the other condition.
    known = {**both, "command": "dextouch train world-model --windows.text-dropout=0.0"}
    digest = write_checkpoint(path, tiny_model, metadata.model_copy(update=known))
    settings = WorldModelSettings(
        checkpoint=tmp_path / "newer.safetensors", guidance=2.0, objects=None,
        placement=Placement(decode_window=2),
    )  # fmt: skip
    # A rollout of an older checkpoint continues without what this cannot take.
    world = open_by_digest(settings, settings.world_name, digest)
    assert world._sampling.guidance == (2.0 if all(shares) else 1.0)
    if all(shares):
        assert open_world(path, sampling=Sampling(guidance=2.0))
        return
    with pytest.raises(InvalidInputError, match=r"in (0|10)% of windows .*with both"):
        open_world(path, sampling=Sampling(guidance=2.0))


def test_shares_of_dropped_windows_are_inherited(tiny_model, metadata):
    given = metadata.model_copy(update={"text_dropout": 0.2, "action_dropout": 0.1})
    ancestor = Checkpoint(tiny_model, given, "0")
    assert dropout_shares(0.0, 0.0, ancestor) == (0.2, 0.1)
    assert dropout_shares(0.0, 0.0, None) == (0.0, 0.0)
    assert dropout_shares(0.0, 0.5, ancestor) == (0.0, 0.5)
