"""Flow matching (Lipman et al. 2023): noisy latents for training, and sampling.

Straight paths: x_t = (1 - t) x_0 + t ε, t from 0 (data) to 1 (noise). The network predicts x_0, or
the velocity v = ε - x_0. Solvers write a step with the share t' / t of the noisy sample that
remains, so that t = 1 and t' = 0 are exact.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import islice, pairwise

import torch
from jaxtyping import Float32
from torch import Tensor

from dextouch.errors import InvalidInputError
from services.world_model.network.attention import JointLayer, KeysValues, Stream, Tokens
from services.world_model.network.configuration import Sampler

# Lower bound of training times: velocities divide by them.
MIN_TIME = 1e-3
# UniPC's half log-odds of data are infinite at t = 1; the same bound as in diffusers.
_MAX_TIME = 1.0 - 1e-6
Latents = Float32[Tensor, "batch ..."]
Times = Float32[Tensor, " batch"]
Denoiser = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


class Euler:
    """Euler's method, of first order."""

    def step(self, noisy: Latents, guess: Latents, t: float, t_next: float) -> Latents:
        """X + (t' - t) (x - x_0) / t, written so that t' = 0 gives x_0 without rounding."""
        keep = t_next / t
        return keep * noisy + (1.0 - keep) * guess


class UniPC:
    """UniPC (Zhao et al. 2023) of order 2 (in the end 1), variant B2, on predictions of x_0."""

    def __init__(self) -> None:
        self._start: Tensor | None = None
        self._guesses: list[Tensor] = []
        self._times: list[float] = []
        self._order = 1

    def step(self, noisy: Latents, guess: Latents, t: float, t_next: float) -> Latents:
        """Correct `noisy`, then extrapolate the last two predictions to t_next."""
        if self._start is not None:
            noisy = self._corrected(self._start, guess, t)
        self._guesses = [*self._guesses[-1:], guess]
        self._times = [*self._times[-1:], t]
        self._order = 1 if t_next == 0.0 else len(self._guesses)
        self._start = noisy
        mean = guess
        if self._order == 2:
            mean = guess + 0.5 * self._slope(_log_odds(t_next) - _log_odds(t))
        return Euler().step(noisy, mean, t, t_next)

    def _corrected(self, start: Tensor, guess: Tensor, t: float) -> Tensor:
        """The sample at t again, now with the prediction there; `start` is the one before."""
        last = self._guesses[-1]
        if self._order == 1:
            return Euler().step(start, last + 0.5 * (guess - last), self._times[-1], t)
        h = _log_odds(t) - _log_odds(self._times[-1])
        ratio = (_log_odds(self._times[-2]) - _log_odds(self._times[-1])) / h
        # Both weights make the step exact for predictions that are linear in the log-odds.
        decay = math.expm1(-h)
        second = decay / -h - 1.0
        third = second / -h - 0.5
        of_older = (second - 2.0 * third) / decay / (1.0 - ratio)
        of_newer = second / decay - of_older
        mean = last + of_older * self._slope(h) + of_newer * (guess - last)
        return Euler().step(start, mean, self._times[-1], t)

    def _slope(self, h: float) -> Tensor:
        """Change of the prediction over h of log-odds, from the last two."""
        older, last = self._guesses
        before = _log_odds(self._times[-2]) - _log_odds(self._times[-1])
        return (older - last) * (h / before)


SOLVERS: dict[Sampler, type[Euler] | type[UniPC]] = {"euler": Euler, "unipc": UniPC}


def _log_odds(t: float) -> float:
    """Half the logarithm of the signal-to-noise ratio, log((1 - t) / t)."""
    t = min(t, _MAX_TIME)
    return math.log1p(-t) - math.log(t)


def shift_time(t: Float32[Tensor, " n"], shift: float) -> Float32[Tensor, " n"]:
    """Shift times towards noise: s t / (1 + (s - 1) t); 0 and 1 stay fixed."""
    return shift * t / (1.0 + (shift - 1.0) * t)


def training_times(batch: int, *, shift: float, generator: torch.Generator) -> Times:
    """Random times in (0, 1], biased towards noise, where the actions matter most."""
    return shift_time(torch.rand(batch, generator=generator), shift).clamp_min(MIN_TIME)


def add_noise(clean: Latents, noise: Latents, t: Times) -> Latents:
    """x_t = (1 - t) x_0 + t ε; exact at both ends."""
    spread = t.view(-1, *[1] * (clean.ndim - 1))
    return (1.0 - spread) * clean + spread * noise


def implied_noise(noisy: Latents, clean: Latents, t: Times) -> Latents:
    """The noise from which `noisy` is on the straight path to `clean`; t > 0."""
    return clean + (noisy - clean) / t.view(-1, *[1] * (clean.ndim - 1))


def clean_from_velocity(noisy: Latents, velocity: Latents, t: Times) -> Latents:
    """x_0 = x_t - t v."""
    return noisy - t.view(-1, *[1] * (noisy.ndim - 1)) * velocity


def sampling_times(num_steps: int, shift: float) -> Float32[Tensor, " times"]:
    """Times from 1 to 0 of a sampler with this many steps."""
    return shift_time(torch.linspace(1.0, 0.0, num_steps + 1), shift)


def sample(
    denoise: Denoiser,
    noise: tuple[Latents, Latents],
    *,
    num_steps: int,
    shift: float,
    sampler: Sampler = "euler",
    stop_after: int | None = None,
) -> tuple[Latents, Latents]:
    """Integrate from noise to data, at least one step, for both streams at once.

    `denoise` predicts clean latents. After `stop_after` of `num_steps` calls they are still noisy.

    Raises:
        InvalidInputError: less than one step.
    """
    if num_steps < 1:
        raise InvalidInputError(f"sampling: got {num_steps} steps, expected at least 1")
    video, tactile = noise
    of_video, of_tactile = SOLVERS[sampler](), SOLVERS[sampler]()
    times = sampling_times(num_steps, shift).tolist()
    for t, t_next in islice(pairwise(times), stop_after):
        now = torch.full((len(video),), t, device=video.device)
        guess_video, guess_tactile = denoise(video, tactile, now)
        video = of_video.step(video, guess_video, t, t_next)
        tactile = of_tactile.step(tactile, guess_tactile, t, t_next)
    return video, tactile


@dataclass(frozen=True)
class CleanTokens:
    """Clean tokens of each stream after the last layer, and the keys and values of each layer.

    They attend to each other only and have flow time 0: the same at every step of the sampler.
    """

    streams: tuple[Tokens, ...]
    layers: tuple[KeysValues, ...]

    @classmethod
    def through(
        cls, layers: Iterable[JointLayer], video: Stream, tactile: Stream | None
    ) -> "CleanTokens":
        """Clean tokens that enter the first layer, taken through all of them."""
        kept = []
        for layer in layers:
            video, tactile, keys_values = layer.update_after(None, video, tactile)
            kept.append(keys_values)
        streams = (video,) if tactile is None else (video, tactile)
        return cls(tuple(stream.tokens for stream in streams), tuple(kept))

    def update(
        self, layers: Iterable[JointLayer], video: Stream, tactile: Stream | None
    ) -> tuple[Stream, Stream | None]:
        """All tokens after the last layer; of those given, only the noisy ones are computed."""
        video = video.split(self.streams[0].shape[1])[1]
        if tactile is not None:
            tactile = tactile.split(self.streams[1].shape[1])[1]
        for layer, past in zip(layers, self.layers, strict=True):
            video, tactile, _ = layer.update_after(past, video, tactile)
        if tactile is None:
            return _joined(self.streams[0], video), None
        return _joined(self.streams[0], video), _joined(self.streams[1], tactile)


def _joined(clean: Tokens, noisy: Stream) -> Stream:
    """All tokens; modulation and so on are those of the noisy ones."""
    return replace(noisy, tokens=torch.cat([clean, noisy.tokens], dim=1))
