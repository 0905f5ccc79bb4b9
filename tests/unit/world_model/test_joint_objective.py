"""The training loss, against numbers worked out by hand from a network that answers as told."""

import numpy as np
import pytest
import torch

from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointLatents
from services.world_model.training.joint_dataset import WindowSampler
from services.world_model.training.joint_objective import LossOptions, contact_or_changing
from services.world_model.training.joint_trainer import TrainingRun
from tests.unit.world_model.conftest import losses


@pytest.fixture
def batch(toy_episodes):
    return WindowSampler(toy_episodes, np.random.default_rng(0), max_steps=17).draw(3, 17)


def _loss_of_errors(model, batch, *, video, tactile):
    """The losses when the network misses the truth by exactly these errors."""
    target = model.targets(batch.images, batch.tactile_kpa)
    guess = JointLatents(target.video + video, target.tactile + tactile)
    model.forward = lambda *_: guess
    return losses(model, batch, generator=torch.Generator().manual_seed(0))


def test_only_the_future_counts(tiny_model, batch):
    target = tiny_model.targets(batch.images, batch.tactile_kpa)
    video, tactile = torch.zeros_like(target.video), torch.zeros_like(target.tactile)
    video[:, 0], tactile[:, 0] = 5.0, 7.0
    loss = _loss_of_errors(tiny_model, batch, video=video, tactile=tactile)
    assert loss.video == 0.0
    assert loss.tactile == 0.0


def test_each_future_latent_and_step_counts_alike(tiny_model, batch):
    target = tiny_model.targets(batch.images, batch.tactile_kpa)
    for latent in (1, 4):
        video, tactile = torch.zeros_like(target.video), torch.zeros_like(target.tactile)
        video[:, latent] = 2.0
        tactile[:, 4 * latent] = 4.0
        loss = _loss_of_errors(tiny_model, batch, video=video, tactile=tactile)
        # 2² in one of 4 latents, 4² in one of 16 steps.
        assert loss.video.item() == pytest.approx(1.0)
        assert loss.tactile.item() == pytest.approx(1.0)


def test_touch_that_was_not_measured_does_not_count(tiny_model, batch):
    target = tiny_model.targets(batch.images, batch.tactile_kpa)
    video, tactile = torch.zeros_like(target.video), torch.ones_like(target.tactile)
    tactile[:, 3, 0] = 100.0
    batch.tactile_valid[:, 3, 0] = False
    loss = _loss_of_errors(tiny_model, batch, video=video, tactile=tactile)
    assert loss.tactile.item() == pytest.approx(1.0)
    # A first touch that was not measured is no anchor: nothing of that hand is learned.
    tactile[:, 1:, 1] = 100.0
    batch.tactile_valid[:, 0, 1] = False
    loss = _loss_of_errors(tiny_model, batch, video=video, tactile=tactile)
    assert loss.tactile.item() == pytest.approx(1.0)


def test_tokens_in_contact_or_changing_by_hand():
    """Contact begins at 2 kPa, a change at 0.5 kPa since the step before."""
    touch = torch.zeros(1, 4, 2, 320)
    touch[0, :, 0, 0] = torch.tensor([2.0, 0.0, 0.0, 0.0])
    touch[0, :, 0, 16] = torch.tensor([0.0, 0.5, 0.5, 0.5])
    touch[0, :, 0, 32] = torch.tensor([1.0, 1.0, 0.5, 0.5])
    touch[0, :, 0, 48] = torch.tensor([1.5, 1.75, 2.0, 1.75])
    touch[0, :, 0, 64] = torch.tensor([0.0, 0.4, 0.8, 1.2])
    touch[0, :, 1, 319] = torch.tensor([1.9, 1.9, 1.9, 2.4])
    # Contact at the start counts for the whole window.
    left = ["xxxx", ".x..", "..x.", "..x.", "....", "...."]
    right = ["....", "....", "....", "....", "....", "...x"]
    found = contact_or_changing(touch, 6)[0]
    assert found.shape == (4, 2, 6)
    for hand, expected in enumerate((left, right)):
        assert ["".join(".x"[int(on)] for on in token) for token in found[:, hand].T] == expected
    assert contact_or_changing(touch, 1)[0, :, :, 0].tolist() == [[True, False]] * 3 + [
        [True, True]
    ]


def test_noise_on_the_start_is_at_most_its_share(tiny_model, batch):
    given = []
    truth = tiny_model.first_latents(build_inputs(batch.requests, tiny_model.config))
    target = tiny_model.targets(batch.images, batch.tactile_kpa)

    def forward(_inputs, first, *_):
        given.append(first)
        return target

    tiny_model.forward = forward
    for share in (0.0, 0.1):
        options, generator = LossOptions(context_noise=share), torch.Generator().manual_seed(0)
        losses(tiny_model, batch, generator=generator, options=options)
    for name in ("video", "tactile"):
        clean, plain, noisy = (getattr(first, name) for first in (truth, *given))
        assert torch.equal(plain, clean)
        # Of each window from none to a tenth of the deviation, within the scatter of few numbers.
        deviation = (noisy - clean).flatten(1).square().mean(dim=1).sqrt() / clean.std()
        assert (deviation > 0).all()
        assert (deviation < 0.13).all()
        assert deviation.max() > 0.01


def test_the_weight_of_touch_scales_its_gradients(toy_episodes, train_settings):
    def gradients(weight):
        optimizer = train_settings.optimizer.model_copy(
            update={"tactile_weight": weight, "max_gradient_norm": 1e9}
        )
        run = TrainingRun(toy_episodes, train_settings.model_copy(update={"optimizer": optimizer}))
        run.fit_codecs()
        run.learn(next(run._batches()))
        heads = (run.model.video.predict, run.model.tactile.predict)
        return [head.weight.grad.clone() for head in heads]

    video_1, tactile_1 = gradients(1.0)
    video_3, tactile_3 = gradients(3.0)
    assert tactile_1.abs().max() > 0
    torch.testing.assert_close(tactile_3, 3.0 * tactile_1)
    torch.testing.assert_close(video_3, video_1)
