"""The World protocol, implemented by the twin, world models and, one day, a real robot.

A world is functional: `step` maps a state to a new one, so that a failed step leaves the old state
unchanged, a step can be replayed, and a rollout can branch. States are opaque to the caller;
`snapshot` and `restore` turn them into bytes for another process.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float64

from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import (
    EVERYTHING,
    Observation,
    ReturnSelector,
    RolloutStart,
    WorldDescription,
)

State = TypeVar("State")


@dataclass(frozen=True)
class StartedRollout(Generic[State]):
    """Result of a start: state, first observation, and the anchor poses of actions."""

    state: State
    observation: Observation
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True)
class SteppedRollout(Generic[State]):
    """Result of an action chunk: the new state and the requested observation of its K steps."""

    state: State
    observation: Observation
    info: dict[str, float] = field(default_factory=dict)


@runtime_checkable
class World(Protocol[State]):
    """A world. Implementations need not be thread-safe."""

    @property
    def description(self) -> WorldDescription:
        """Capabilities of this world."""
        ...

    def reset(self, start: RolloutStart) -> StartedRollout[State]:
        """Start a rollout.

        Raises:
            UnknownNameError: a task that this world lacks.
            InvalidInputError: an unsupported kind of start.
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
        """Advance by one action chunk, which the world validates (`check_actions`).

        Args:
            state: from `reset`, `step` or `restore`; it is not changed.
            actions: [K, 67], row i the pose at step i+1 of the chunk, relative to the rollout's
                step 0 (measured poses), of the action kind the rollout was started with.
            seed: of the noise of this chunk; equal state, actions and seed give an equal
                observation, regardless of other rollouts.
            selector: part of the observation to return. The result equals `Observation.selected` of
                the full one, so a world can skip rendering unrequested images. The new state does
                not depend on it.

        Raises:
            InvalidInputError: wrong shape, NaN, infinity, or what this world cannot reach; nothing
                has changed.
            EndedError: the world cannot continue from this state, for the given reason; the state
                remains valid for `snapshot`.
        """
        ...

    def snapshot(self, state: State) -> bytes:
        """Serialize a state (without pickle) for `restore` of the same world."""
        ...

    def restore(self, data: bytes) -> State:
        """Restore the state of a snapshot.

        Raises:
            InvalidInputError: not a snapshot of this world.
        """
        ...


@runtime_checkable
class BatchWorld(World[State], Protocol[State]):
    """A world that advances several rollouts together faster than one by one."""

    def step_batch(
        self,
        states: Sequence[State],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[State]]:
        """`step` for each entry; results do not depend on the other entries.

        Args:
            states: one per rollout.
            actions: chunks of one length.
            seeds: one per rollout.
            selectors: one per rollout; None requests everything.
        """
        ...
