"""Consistency training: the same end from all times of a path, and one of several futures."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from services.networks.optimizer import Budget, OptimizerLoop
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointLatents, Sampling
from services.world_model.paper_settings import OptimizerSettings, TrainSettings, WindowSettings
from services.world_model.training.joint_dataset import WindowPosition, stack_windows
from services.world_model.training.joint_objective import LossOptions, errors, examples_of, own_ends
from services.world_model.training.joint_trainer import TrainingRun
from tests.unit.world_model.test_options import model_with


@pytest.mark.parametrize("num_steps", [1, 2])
@pytest.mark.parametrize("prediction", ["clean", "velocity"])
def test_targets_are_ends_from_one_step_earlier_and_recorded_ones_at_the_end(
    tiny_config, toy_episodes, prediction, num_steps
):
    model = model_with(tiny_config, prediction=prediction)
    batch = stack_windows([one.cut(WindowPosition(0, 3, 17)) for one in toy_episodes[:4]])
    options = LossOptions(consistency_steps=num_steps)
    examples = examples_of(
        model, batch, generator=torch.Generator().manual_seed(2), options=options
    )
    t, noisy = examples.t, examples.noisy
    spread = t.view(-1, 1, 1, 1)
    target = examples.target.video
    ends = noisy.video - spread * target if prediction == "velocity" else target
    clean = model.targets(batch.images, batch.tactile_kpa).video
    # The path's noise, and its place a half or all of the time earlier.
    noise = (noisy.video - (1 - spread) * clean) / spread
    earlier = (t - 1.0 / num_steps).clamp_min(0.0)
    place = earlier.view(-1, 1, 1, 1)
    assert (earlier > 0).any() == (num_steps == 2)
    touch = replace(noisy, video=(1 - place) * clean + place * noise)
    inputs = build_inputs(batch.requests, model.config)
    with torch.no_grad():
        # Touch earlier on its path, too.
        felt = model.targets(batch.images, batch.tactile_kpa).tactile
        wide, back = t.view(-1, 1, 1, 1, 1), earlier.view(-1, 1, 1, 1, 1)
        touch = replace(
            touch,
            tactile=(1 - back) * felt + back * (noisy.tactile - (1 - wide) * felt) / wide,
        )
        guess = model(inputs, model.first_latents(inputs), touch, earlier.clamp_min(1e-3)).video
    expected = touch.video - place * guess if prediction == "velocity" else guess
    expected = torch.where(place > 0, expected, clean)
    torch.testing.assert_close(ends, expected, rtol=0, atol=2e-3)
    zero = torch.zeros(len(t))
    kept = own_ends(model, inputs, examples.first, noisy, noisy, zero)
    assert torch.equal(kept.video, noisy.video)
    assert torch.equal(kept.tactile, noisy.tactile)


def _future(episode, side):
    """Something that commands do not decide: a light and touch on the left, or on the right."""
    images, touch = np.repeat(episode.images[:1], 17, axis=0), np.zeros_like(episode.tactile_kpa)
    images[5:, 8:24, slice(0, 12) if side == 0 else slice(20, 32)] = [255, 40, 40]
    touch[5:, side, :40] = 30.0
    return replace(episode, images=images, tactile_kpa=touch, episode_id=f"toy-{side}")


def _distances(model, window, futures, num_steps):
    """Image and touch error of 64 samples to both futures, over the error between these."""
    model.eval()
    draw = torch.Generator().manual_seed(7)
    noise = [model.noise(17, draw) for _ in range(64)]
    together = JointLatents(
        torch.cat([one.video for one in noise]), torch.cat([one.tactile for one in noise])
    )
    inputs = build_inputs([window.request] * 64, model.config)
    seen = model.predict(inputs, together, sampling=Sampling(num_steps, "euler"))
    found = []
    for samples, both in (
        (seen.images, [torch.from_numpy(one.images[1:] / np.float32(255)) for one in futures]),
        (seen.tactile_kpa, [torch.from_numpy(one.tactile_kpa[1:]) for one in futures]),
    ):
        gap = (both[0] - both[1]).square().mean()
        found.append(
            torch.stack([(samples - one).square().flatten(1).mean(1) for one in both]) / gap
        )
    return found


@pytest.mark.long
def test_one_call_draws_one_of_two_futures_where_self_forcing_draws_their_mean(
    tiny_config, toy_episode, tmp_path
):
    network = tiny_config.model_copy(update={"prediction": "velocity", "sampling_steps": 1})
    futures = [_future(toy_episode(0, 17), side) for side in range(2)]
    settings = TrainSettings(
        episodes="unused", output=tmp_path / "model.safetensors", network=network,
        windows=WindowSettings(fit_windows=16, short_fraction=0.0), max_steps=1,
    )  # fmt: skip
    run = TrainingRun(futures, settings)
    run.fit_codecs()
    windows = [futures[i % 2].cut(WindowPosition(i % 2, 0, 17)) for i in range(16)]
    batch, draw = stack_windows(windows), torch.Generator().manual_seed(0)

    def trained(num_steps, rate, options):
        run.model.train()
        budget = Budget(max_steps=num_steps, paced_by_steps=True)
        rates = OptimizerSettings(batch=16, warmup_steps=20, learning_rate=rate).options()
        loop = OptimizerLoop(run.model, rates, budget)
        for step in range(num_steps):
            examples = examples_of(run.model, batch, generator=draw, options=options(step))
            loop.optimizer.zero_grad()
            loss = errors(run.model, examples, "float32")
            (loss.video + loss.tactile).backward()
            loop.step(video=loss.video.detach(), touch=loss.tactile.detach())
            budget.advance()

    trained(400, 3e-3, lambda _: LossOptions())
    start = {name: one.clone() for name, one in run.model.state_dict().items()}
    nearest = {}
    for name, options in {
        "self-forcing": lambda _: LossOptions(own_noisy=True),
        "consistency": lambda step: LossOptions(consistency_steps=4 * 2 ** min(5, step // 50)),
    }.items():
        run.model.load_state_dict(start)
        trained(300, 1e-3, options)
        images, touch = _distances(run.model, windows[0], futures, 1)
        left = images.argmin(0) == 0
        assert 0.25 < left.float().mean() < 0.75
        nearest[name] = images.min(0).values.mean().item(), touch.min(0).values.mean().item()
        if name == "consistency":
            # What is seen and what is felt are of one future.
            assert (left == (touch.argmin(0) == 0)).float().mean() > 0.9
    # A quarter of the gap is the error of the mean of both.
    assert nearest["self-forcing"] > (0.22, 0.22)
    assert nearest["consistency"][0] < 0.6 * nearest["self-forcing"][0]
    assert nearest["consistency"][1] < 0.7 * nearest["self-forcing"][1]
