"""Repeated measurements in interleaved rounds, with median and spread, and requirements on them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from dextouch.errors import InvalidInputError

Sense = Literal["at least", "at most"]


@dataclass(frozen=True)
class Figure:
    """A quantity measured several times, in the order of the rounds."""

    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if not self.values or not np.isfinite(self.values).all():
            raise InvalidInputError(
                f"figure: got {self.values}, expected at least one value, all of them finite"
            )

    @classmethod
    def of(cls, values: Sequence[float]) -> "Figure":
        """The figure of a list of measurements."""
        return cls(tuple(float(value) for value in values))

    @property
    def median(self) -> float:
        """Median over the rounds."""
        return float(np.median(self.values))

    @property
    def low(self) -> float:
        """Minimum over the rounds."""
        return min(self.values)

    @property
    def high(self) -> float:
        """Maximum over the rounds."""
        return max(self.values)

    def over(self, other: "Figure") -> "Figure":
        """Ratio to another figure round by round, which cancels the load of the machine.

        Raises InvalidInputError for another number of rounds.
        """
        if len(self.values) != len(other.values):
            raise InvalidInputError(
                f"figure: got {len(self.values)} and {len(other.values)} rounds, expected the "
                "same number; measure both in one run"
            )
        return Figure.of([a / b for a, b in zip(self.values, other.values, strict=True)])

    def scaled(self, factor: float) -> "Figure":
        """The figure in another unit."""
        return Figure.of([value * factor for value in self.values])

    def inverse(self, of: float = 1.0) -> "Figure":
        """`of` divided by the figure, for example a rate from a time."""
        return Figure.of([of / value for value in self.values])

    def text(self) -> str:
        """Median, with half the range of the rounds where there were several."""
        if len(self.values) == 1:
            return f"{self.median:.3g}"
        return f"{self.median:.3g} ±{(self.high - self.low) / 2:.2g}"


@dataclass(frozen=True)
class Requirement:
    """A requirement with its measured value; None if not measured in this run."""

    what: str
    figure: float | None
    sense: Sense
    bound: float
    unit: str = ""

    @property
    def is_met(self) -> bool | None:
        """Whether the bound is met; None if not measured."""
        if self.figure is None:
            return None
        return self.figure >= self.bound if self.sense == "at least" else self.figure <= self.bound

    def verdict(self) -> str:
        """One word for the table."""
        return {None: "not measured", True: "pass", False: "FAIL"}[self.is_met]


def at_least(what: str, figure: float | None, bound: float, unit: str = "") -> Requirement:
    """The requirement that a figure is not below a bound."""
    return Requirement(what, figure, "at least", bound, unit)


def at_most(what: str, figure: float | None, bound: float, unit: str = "") -> Requirement:
    """The requirement that a figure is not above a bound."""
    return Requirement(what, figure, "at most", bound, unit)


T = TypeVar("T")


def every_round(measure: Callable[[], T]) -> Callable[[int], T]:
    """A subject of `interleaved` that is measured in the same way in every round."""
    return lambda _: measure()


def interleaved(
    subjects: Mapping[str, Callable[[int], T]],
    num_rounds: int,
    *,
    on_step: Callable[[str], None] = lambda _: None,
) -> dict[str, list[T]]:
    """Measure all subjects once per round, rotating the first one; returns the results of each.

    Other load of the machine and cache effects then affect all subjects alike. A subject is given
    the round's index, `on_step` its name before it is measured. Raises InvalidInputError without a
    round.
    """
    if num_rounds < 1:
        raise InvalidInputError(f"rounds: got {num_rounds}, expected at least 1")
    names = list(subjects)
    results: dict[str, list[T]] = {name: [] for name in names}
    for round_index in range(num_rounds):
        turn = round_index % max(1, len(names))
        for name in names[turn:] + names[:turn]:
            on_step(name)
            results[name].append(subjects[name](round_index))
    return results
