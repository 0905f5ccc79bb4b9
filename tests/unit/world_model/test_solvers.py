"""UniPC against diffusers, and the order of both solvers on a flow whose solution is known."""

from functools import cache

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from dextouch.errors import InvalidInputError
from services.world_model.joint_world import JointWorld
from services.world_model.network.flow_matching import SOLVERS, sample
from services.world_model.network.model import Sampling
from services.world_model.world import open_world
from tests.unit.world_model.test_joint_world import make_start

MEANS, DEVIATIONS, WEIGHTS = np.array([-2.0, 0.5, 3.0]), np.array([0.5, 0.3, 0.8]), [0.3, 0.5, 0.2]


def best_guess(x, t):
    """E[x_0 | x_t] of a mixture of Gaussians, in closed form."""
    x = np.asarray(x, dtype=np.float64)[..., None]
    spread = (1 - t) ** 2 * DEVIATIONS**2 + t**2
    logits = np.log(WEIGHTS) - 0.5 * np.log(spread) - (x - (1 - t) * MEANS) ** 2 / (2 * spread)
    shares = np.exp(logits - logits.max(-1, keepdims=True))
    shares /= shares.sum(-1, keepdims=True)
    gain = (1 - t) * DEVIATIONS**2 / spread
    return (shares * (MEANS + gain * (x - (1 - t) * MEANS))).sum(-1)


def denoise(video, tactile, t):
    guesses = (best_guess(x.numpy(), float(t[0])) for x in (video, tactile))
    return tuple(torch.from_numpy(guess.astype(np.float32)) for guess in guesses)


def noise():
    generator = torch.Generator().manual_seed(0)
    return torch.randn(3, 5, 4, generator=generator), torch.randn(3, 17, 2, generator=generator)


@cache
def exact(index):
    """scipy's solution of dx/dt = (x - E[x_0 | x]) / t; the flow is smooth down to t = 0."""
    start = noise()[index].numpy()
    solved = solve_ivp(
        lambda t, x: (x - best_guess(x, t)) / t, (1.0, 1e-6), start.ravel(),
        method="DOP853", rtol=1e-10, atol=1e-10,
    )  # fmt: skip
    return solved.y[:, -1].reshape(start.shape)


@pytest.mark.long
@pytest.mark.parametrize("num_steps", [1, 2, 3, 5, 20])
@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_unipc_is_that_of_diffusers(num_steps, shift):
    from diffusers import UniPCMultistepScheduler  # seconds, in every process that collects tests

    found = sample(denoise, noise(), num_steps=num_steps, shift=shift, sampler="unipc")
    for index, start in enumerate(noise()):
        scheduler = UniPCMultistepScheduler(
            prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=shift,
            solver_order=2, solver_type="bh2",
        )  # fmt: skip
        grid = np.linspace(1.0, 0.0, num_steps + 1)[:-1]
        scheduler.set_timesteps(num_steps, sigmas=grid)
        # In float64: near t = 1 the scheduler's own float32 leaves few digits of 1 - t.
        times = shift * np.append(grid, 0.0) / (1 + (shift - 1) * np.append(grid, 0.0))
        scheduler.sigmas = torch.from_numpy(times.clip(max=1 - 1e-6))
        x = start.double()
        for step, t in enumerate(scheduler.timesteps):
            sigma = float(scheduler.sigmas[step])
            velocity = (x - torch.from_numpy(best_guess(x.numpy(), float(times[step])))) / sigma
            x = scheduler.step(velocity, t, x).prev_sample
        torch.testing.assert_close(found[index].double(), x, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("sampler", "order"), [("euler", 1), ("unipc", 2)])
def test_the_error_falls_with_the_order_of_the_solver(sampler, order):
    errors = []
    for num_steps in (16, 64):
        found = sample(denoise, noise(), num_steps=num_steps, shift=1.0, sampler=sampler)
        errors.append(max(np.abs(f.numpy() - exact(i)).max() for i, f in enumerate(found)))
    assert np.log(errors[0] / errors[1]) / np.log(4) == pytest.approx(order, abs=0.4)


def test_unipc_needs_fewer_steps():
    errors = {
        sampler: np.abs(
            sample(denoise, noise(), num_steps=8, shift=3.0, sampler=sampler)[0].numpy() - exact(0)
        ).max()
        for sampler in SOLVERS
    }
    assert errors["unipc"] < 0.6 * errors["euler"]


@pytest.mark.parametrize("num_steps", [1, 2, 64])
@pytest.mark.parametrize("sampler", list(SOLVERS))
def test_the_last_step_lands_on_the_prediction(sampler, num_steps):
    data, start = noise(), (torch.ones(3, 5, 4), torch.ones(3, 17, 2))
    found = sample(lambda *_: data, start, num_steps=num_steps, shift=3.0, sampler=sampler)
    assert all(torch.equal(a, b) for a, b in zip(found, data, strict=True))


def test_a_world_samples_as_it_is_asked_to(checkpoint, toy_episode, tmp_path):
    episode = toy_episode(3)
    for weight in checkpoint.model.parameters():
        weight.add_(0.1 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(0)))
    chunk = episode.actions["commanded"][1:17]

    def touch(*sampling):
        world = JointWorld(checkpoint, sampling=Sampling(*sampling))
        state = world.reset(make_start(episode)).state
        return world.step(state, chunk, seed=0).observation.tactile_kpa

    stored = touch()
    assert np.array_equal(touch(None, "euler"), stored)
    assert not np.array_equal(touch(4, "unipc"), touch(4))
    with pytest.raises(InvalidInputError, match="without sampling"):
        open_world(sampling=Sampling(sampler="unipc"))
