"""The World protocol: what the twin, every world model and, one day, a real robot implement.

A world is functional: `step` takes a state and gives a new one, so that a failed step leaves the
old state as it was, a step can be replayed, and a rollout can branch. States are opaque to the
caller; `snapshot` and `restore` turn them into bytes for another process.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float64

from dextouch.hands.actions import AnchorPoses
from dextouch.schemas.rollouts import (
    EVERYTHING,
    ActionKind,
    Observation,
    ReturnSelector,
    RolloutStart,
    WorldDescription,
    WorldKind,
)

State = TypeVar("State")

__all__ = [
    "EVERYTHING",
    "ActionKind",
    "BatchWorld",
    "Observation",
    "ReturnSelector",
    "RolloutStart",
    "StartedRollout",
    "State",
    "SteppedRollout",
    "World",
    "WorldDescription",
    "WorldKind",
]


@dataclass(frozen=True)
class StartedRollout(Generic[State]):
    """A world's answer to a start: its state, what is seen, and the poses actions refer to."""

    state: State
    observation: Observation
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True)
class SteppedRollout(Generic[State]):
    """A world's answer to an action chunk: the new state and what was asked for of the K steps."""

    state: State
    observation: Observation
    info: dict[str, float] = field(default_factory=dict)


@runtime_checkable
class World(Protocol[State]):
    """One world. Implementations are used by one thread at a time."""

    @property
    def description(self) -> WorldDescription:
        """What this world is and accepts."""
        ...

    def reset(self, start: RolloutStart) -> StartedRollout[State]:
        """Begin a future.

        Raises:
            UnknownNameError: a task this world does not have.
            InvalidInputError: a start this world cannot begin from.
        """
        ...

    def step(
        self,
        state: State,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[State]:
        """Advance by one checked action chunk.

        Args:
            state: from `reset`, `step` or `restore`; it is not changed.
            actions: [K, 67], row i the pose at step i+1 of the chunk, relative to the rollout's
                step 0 (measured poses), of the action kind the rollout was started with.
            seed: of the noise of this chunk; the same state, actions and seed give the same
                observation whatever else the world is doing.
            selector: what the observation holds: it equals `Observation.selected` of the one that
                holds everything, so a world need not draw images that nobody asks for. The new
                state does not depend on it.

        Raises:
            EndedError: the world goes no further from this state, for the reason it names, rather
                than answer with noise; the state stays good for `snapshot`.
        """
        ...

    def snapshot(self, state: State) -> bytes:
        """The state as bytes (no pickle) that `restore` of the same world accepts."""
        ...

    def restore(self, data: bytes) -> State:
        """The state of a snapshot.

        Raises:
            InvalidInputError: bytes that are no snapshot of this world.
        """
        ...


@runtime_checkable
class BatchWorld(World[State], Protocol[State]):
    """A world that advances several rollouts together for less than the sum of their times."""

    def step_batch(
        self,
        states: Sequence[State],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[State]]:
        """`step` for each entry; who else is in the batch changes no answer.

        Args:
            states: one a rollout.
            actions: chunks of one length.
            seeds: one a rollout.
            selectors: one a rollout; None asks for everything.
        """
        ...
