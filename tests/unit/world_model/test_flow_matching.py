"""The path between data and noise holds exactly at its ends and wherever sampling starts."""

import pytest
import torch

from dextouch.errors import InvalidInputError
from services.world_model.network.flow_matching import (
    MIN_TIME,
    add_noise,
    implied_noise,
    sample,
    shift_time,
    training_times,
)


def _pair(seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(3, 5, 4, generator=generator), torch.randn(3, 17, 2, generator=generator)


def test_both_ends_of_the_path_are_exact():
    (clean, _), (noise, _) = _pair(0), _pair(1)
    assert torch.equal(add_noise(clean, noise, torch.zeros(3)), clean)
    assert torch.equal(add_noise(clean, noise, torch.ones(3)), noise)


def test_the_noise_of_a_point_of_the_path_is_that_of_its_end():
    """By hand: a third of the way from 3 to 9 lies 5."""
    third, clean = torch.tensor([1 / 3]), torch.tensor([[3.0]])
    torch.testing.assert_close(
        add_noise(clean, torch.tensor([[9.0]]), third), torch.tensor([[5.0]])
    )
    torch.testing.assert_close(
        implied_noise(torch.tensor([[5.0]]), clean, third), torch.tensor([[9.0]])
    )


def test_shifted_times_keep_their_ends_and_lean_to_noise():
    t = torch.linspace(0, 1, 11)
    shifted = shift_time(t, 5.0)
    assert shifted[0] == 0
    assert shifted[-1] == 1
    assert (shifted[1:-1] > t[1:-1]).all()
    assert torch.equal(shift_time(t, 1.0), t)


def test_training_times_never_divide_by_zero():
    t = training_times(20_000, shift=5.0, generator=torch.Generator().manual_seed(0))
    assert t.min() >= MIN_TIME
    assert t.max() <= 1
    assert 0.7 < float(t.mean()) < 0.8


@pytest.mark.parametrize("num_steps", [1, 2, 3, 8, 64])
def test_a_perfect_guess_is_reached_exactly(num_steps):
    data, noise = _pair(0), _pair(1)
    reached = sample(lambda *_: data, noise, num_steps=num_steps, shift=3.0)
    assert torch.equal(reached[0], data[0])
    assert torch.equal(reached[1], data[1])


def test_a_gaussian_is_sampled_with_its_own_spread():
    """Data N(0, 4): the best guess of x_0 is known, so many steps must give deviation 2."""
    noise = (torch.randn(20_000, 1, generator=torch.Generator().manual_seed(0)),) * 2

    def best_guess(video, tactile, t):
        t = t[:, None]
        gain = (1 - t) * 4 / ((1 - t) ** 2 * 4 + t**2)
        return gain * video, gain * tactile

    errors = []
    for num_steps in (4, 16, 64):
        video, _ = sample(best_guess, noise, num_steps=num_steps, shift=1.0)
        errors.append(abs(float(video.std()) - 2.0))
    assert errors[2] < 0.05
    assert errors[0] > errors[1] > errors[2]


def test_sampling_asks_at_falling_times_from_one():
    asked = []

    def denoise(video, tactile, t):
        asked.append(float(t[0]))
        return video, tactile

    sample(denoise, _pair(0), num_steps=4, shift=3.0)
    assert asked[0] == 1.0
    assert asked == sorted(asked, reverse=True)
    assert asked[-1] > 0


def test_no_step_is_refused():
    with pytest.raises(InvalidInputError, match="at least 1"):
        sample(lambda *_: _pair(0), _pair(1), num_steps=0, shift=1.0)
