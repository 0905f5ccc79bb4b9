"""A world that always computes batches of one size, so that results are equal bit for bit."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.schemas import EVERYTHING, ReturnSelector, RolloutStart, WorldDescription
from dextouch.worlds.world import BatchWorld, StartedRollout, SteppedRollout

State = TypeVar("State")
_NOTHING = ReturnSelector(cameras=(), steps="last")


class FixedBatchWorld(BatchWorld[State]):
    """Pads the batches of a world to a fixed size.

    Matrix products of another batch size round differently, so that a rollout depends on how many
    others are stepped with it. With a fixed size it does not, at the cost of computing `size`
    entries for every chunk.

    Args:
        world: a world with `step_batch`.
        size: entries of every batch.
    """

    def __init__(self, world: BatchWorld[State], size: int) -> None:
        if size < 1:
            raise InvalidInputError(f"fixed batch: got a size of {size}, expected at least 1")
        self._world = world
        self._size = size

    @property
    def description(self) -> WorldDescription:
        """That of the world."""
        return self._world.description

    def reset(self, start: RolloutStart) -> StartedRollout[State]:
        """See World."""
        return self._world.reset(start)

    def step_batch(
        self,
        states: Sequence[State],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[State]]:
        """See BatchWorld.

        Raises:
            InvalidInputError: more entries than the fixed size.
        """
        missing = self._size - len(states)
        if missing < 0:
            raise InvalidInputError(
                f"fixed batch: got {len(states)} entries, expected at most {self._size}"
            )
        requested = [EVERYTHING] * len(states) if selectors is None else list(selectors)
        found = self._world.step_batch(
            [*states, *[states[-1]] * missing],
            np.concatenate([actions, np.repeat(actions[-1:], missing, axis=0)]),
            seeds=[*seeds, *[seeds[-1]] * missing],
            selectors=[*requested, *[_NOTHING] * missing],
        )
        return found[: len(states)]

    def snapshot(self, state: State) -> bytes:
        """See World."""
        return self._world.snapshot(state)

    def restore(self, data: bytes) -> State:
        """See World."""
        return self._world.restore(data)
