"""Interleaved measurements, so that all subjects see the same load of the machine."""

from collections.abc import Callable, Mapping
from typing import TypeVar

from dextouch.errors import InvalidInputError

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
    the round's index, `on_step` its name before it is measured.

    Raises:
        InvalidInputError: no round.
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
