"""Solvers of the flow: how a sample moves from one time to the next, given predictions of x_0.

Both write a step with the share `keep` = t' / t of the noisy sample that remains. For straight
paths that is the exact solution for a constant prediction, without a logarithm, so that t = 1 and
t' = 0 are exact.
"""

import math
from typing import Protocol

from jaxtyping import Float32
from torch import Tensor

from services.world_model.network.configuration import Sampler

# UniPC's half log-odds of data are infinite at t = 1; the same bound as in diffusers.
_MAX_TIME = 1.0 - 1e-6


class Solver(Protocol):
    """Solver of one stream; it may remember earlier predictions of the same sample."""

    def step(
        self,
        noisy: Float32[Tensor, "batch ..."],
        guess: Float32[Tensor, "batch ..."],
        t: float,
        t_next: float,
    ) -> Float32[Tensor, "batch ..."]:
        """Move `noisy` from t to t_next with the prediction of x_0 at t."""
        ...


class Euler:
    """Euler's method, of first order."""

    def step(
        self,
        noisy: Float32[Tensor, "batch ..."],
        guess: Float32[Tensor, "batch ..."],
        t: float,
        t_next: float,
    ) -> Float32[Tensor, "batch ..."]:
        """X + (t' - t) (x - x_0) / t, written so that t' = 0 gives x_0 without rounding."""
        keep = t_next / t
        return keep * noisy + (1.0 - keep) * guess


class UniPC:
    """UniPC (Zhao et al. 2023) of order 2, variant B2, on predictions of x_0.

    Each call of the network first corrects the sample it was called with, then predicts the next
    one. The last step is of first order and returns the last prediction.
    """

    def __init__(self) -> None:
        self._start: Tensor | None = None
        self._guesses: list[Tensor] = []
        self._times: list[float] = []
        self._order = 1

    def step(
        self,
        noisy: Float32[Tensor, "batch ..."],
        guess: Float32[Tensor, "batch ..."],
        t: float,
        t_next: float,
    ) -> Float32[Tensor, "batch ..."]:
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
