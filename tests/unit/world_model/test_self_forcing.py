"""Self-forcing trains on what a served rollout starts from and what its sampler reaches."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from services.world_model.checkpoints import read_checkpoint
from services.world_model.command_line import run_distill
from services.world_model.joint_world import JointWorld
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointLatents
from services.world_model.training import joint_objective
from services.world_model.training.distribution import Processes
from services.world_model.training.joint_dataset import WindowPosition, WindowSampler, stack_windows
from services.world_model.training.joint_objective import LossOptions, own_context, own_noisy
from services.world_model.training.joint_trainer import train, train_on
from tests.unit.world_model.conftest import losses
from tests.unit.world_model.test_joint_world import make_start
from tests.unit.world_model.test_options import model_with
from tests.unit.world_model.test_resume_files import assert_same_run


def generator():
    return torch.Generator().manual_seed(3)


@pytest.fixture
def batch(toy_episodes):
    """Windows of two chunks."""
    return stack_windows(
        [
            toy_episodes[k].cut(WindowPosition(k, 2 * k, 33, action_kind="commanded"))
            for k in range(3)
        ]
    )


def test_the_second_chunk_begins_like_that_of_a_served_rollout(
    checkpoint, batch, toy_episodes, monkeypatch
):
    monkeypatch.setattr(joint_objective, "OWN_CONTEXT_SHARE", 1.0)
    # Not measured: step 3 of the first chunk, and step 4 of the second, of one hand each.
    batch.tactile_valid[1, 3, 1] = batch.tactile_valid[2, 16 + 4, 0] = False
    seconds = own_context(checkpoint.model, batch, generator=generator(), processes=Processes())
    assert (~seconds.tactile_valid).nonzero().tolist() == [[2, 4, 0]]
    assert seconds.tactile_valid.shape == (3, 17, 2)
    world = JointWorld(checkpoint)
    for index, (given, made) in enumerate(zip(batch.requests, seconds.requests, strict=True)):
        start = make_start(toy_episodes[index], 2 * index)
        state = world.reset(start).state
        # Before training, predictions do not depend on the noise.
        stepped = world.step(state, given.actions[1:17], seed=0)
        seen = stepped.observation
        assert np.array_equal(made.first_image, seen.images["camera_head"][-1])
        np.testing.assert_allclose(made.first_tactile_kpa, seen.tactile_kpa[-1], atol=1e-4)
        assert torch.equal(seconds.images[index, 0], torch.from_numpy(made.first_image))
        later = WindowPosition(
            index, 2 * index + 16, 17, action_kind="commanded", from_command=True
        )
        truth = toy_episodes[index].cut(later)
        np.testing.assert_allclose(made.actions, truth.request.actions, atol=1e-9)
        anchors = made.anchor.as_tuple(), truth.request.anchor.as_tuple()
        np.testing.assert_allclose(*anchors, atol=1e-9)
        assert np.array_equal(seconds.images[index, 1:], truth.images[1:])
        assert np.array_equal(seconds.tactile_kpa[index, 1:], truth.tactile_kpa[1:])
    monkeypatch.setattr(joint_objective, "OWN_CONTEXT_SHARE", 0.0)
    firsts = own_context(checkpoint.model, batch, generator=generator(), processes=Processes())
    assert torch.equal(firsts.images, batch.images[:, :17])
    assert np.array_equal(firsts.requests[1].actions, batch.requests[1].actions[:17])


@pytest.mark.parametrize("prediction", ["clean", "velocity"])
def test_noisy_latents_are_those_that_the_sampler_reaches(tiny_config, batch, prediction):
    model = model_with(tiny_config, prediction=prediction, sampling_steps=2)
    inputs = build_inputs(
        [replace(r, actions=r.actions[:17]) for r in batch.requests], model.config
    )
    first = model.first_latents(inputs)
    one = model.noise(17, generator())
    noise = JointLatents(one.video.repeat(3, 1, 1, 1), one.tactile.repeat(3, 1, 1, 1, 1))
    with torch.no_grad():
        guess = model(inputs, first, noise, torch.ones(3))
    clean = (
        guess
        if prediction == "clean"
        else JointLatents(noise.video - guess.video, noise.tactile - guess.tactile)
    )
    seen = set()
    for seed in range(8):
        noisy, t = own_noisy(model, inputs, first, noise, torch.Generator().manual_seed(seed))
        seen.add(round(float(t[0]), 6))
        keep = float(t[0])
        for got, start, end in (
            (noisy.video, noise.video, clean.video),
            (noisy.tactile, noise.tactile, clean.tactile),
        ):
            torch.testing.assert_close(got, keep * start + (1 - keep) * end)
    # Shift 3: 3 · 0.5 / (1 + 2 · 0.5).
    assert seen == {1.0, 0.75}


@pytest.mark.parametrize("prediction", ["clean", "velocity"])
def test_the_recorded_future_has_no_loss(tiny_config, toy_episodes, prediction):
    model = model_with(tiny_config, prediction=prediction, sampling_steps=2)
    batch = WindowSampler(toy_episodes, np.random.default_rng(0), max_steps=17).draw(2, 17)
    clean = model.targets(batch.images, batch.tactile_kpa)

    def perfect(_, __, noisy, t):
        if prediction == "clean":
            return clean
        return JointLatents(
            (noisy.video - clean.video) / t[:, None, None, None],
            (noisy.tactile - clean.tactile) / t[:, None, None, None, None],
        )

    model.forward = perfect
    for seed in range(4):
        loss = losses(
            model,
            batch,
            generator=torch.Generator().manual_seed(seed),
            options=LossOptions(own_noisy=True),
        )
        assert loss.video < 1e-10
        assert loss.tactile < 1e-10


@pytest.mark.long
def test_a_checkpoint_is_distilled_and_an_interrupted_run_goes_on(
    toy_store, toy_episodes, toy_episode, train_settings, tmp_path
):
    heldout = [toy_episode(10_000, 41)]
    settings = train_settings.model_copy(update={"max_steps": 2, "cpu_budget_s": 1e6})
    teacher = train_on(toy_episodes, heldout, settings)
    few = settings.network.model_copy(update={"sampling_steps": 1})
    changes = {"init": teacher.checkpoint, "network": few, "self_forcing": True}
    changes |= {"output": tmp_path / "few.safetensors", "max_steps": 3}
    student = settings.model_copy(update=changes)
    expected = train_on(toy_episodes, heldout, student)
    stored = read_checkpoint(expected.checkpoint).metadata
    assert stored.network.sampling_steps == 1
    assert stored.initialized_from == teacher.digest

    class StoppedError(Exception):
        pass

    def stop(_):
        raise StoppedError

    changes = {"output": tmp_path / "again.safetensors", "state_every_s": 0.0, "resume": True}
    again = student.model_copy(update=changes)
    with pytest.raises(StoppedError):
        train_on(toy_episodes, heldout, again, stop)
    assert_same_run(train_on(toy_episodes, heldout, again), expected)


@pytest.mark.long
@pytest.mark.parametrize("objective", ["self_forcing", "consistency"])
def test_the_command_takes_the_network_from_the_checkpoint(
    toy_store, train_settings, tmp_path, objective
):
    settings = train_settings.model_copy(update={"max_steps": 1, "heldout_percent": 50})
    teacher = train(settings)
    output = tmp_path / "few.safetensors"
    flags = ["--init", str(teacher.checkpoint), "--steps", "1", "--output", str(output)]
    flags += ["--episodes", str(toy_store.root), "--max-steps", "1", "--heldout-percent", "50"]
    flags += ["--objective", objective]
    assert run_distill([*flags, "--optimizer.batch", "2"]) == 0
    metadata = read_checkpoint(output).metadata
    assert metadata.network == settings.network.model_copy(update={"sampling_steps": 1})
    assert "--self-forcing" in metadata.command
    assert ("--consistency" in metadata.command) == (objective == "consistency")
