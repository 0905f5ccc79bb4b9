"""The protocol of policies, which act in any world."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from dextouch.hands.actions import AnchorPoses
from dextouch.schemas.rollouts import Observation


@dataclass(frozen=True)
class PolicyStart:
    """What a policy may know before its first observation.

    `anchor` are the absolute poses of the rollout's step 0, which all actions are relative to;
    `seed` is for the policy's own random numbers.
    """

    task: str
    instruction: str
    seed: int
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


@runtime_checkable
class Policy(Protocol):
    """Acts in any world: the calls and arrays are the same in all of them (docs/policies.md).

    A policy with an attribute `looks` that is False gets no images after the first step, so that
    worlds need not make them. With `looks = "last"` it may get nothing but the last step of each
    chunk. `tasks` (names) are what it can do; `dextouch bench evaluator` leaves it out of others.
    """

    def reset(self, start: PolicyStart) -> None:
        """Forget the last rollout and begin another."""
        ...

    def act(self, observation: Observation) -> Float64[np.ndarray, "steps 67"]:
        """The next chunk, from everything seen since the last call (the last step is now).

        Rows are poses and joint angles as commands, relative to the rollout's step 0; their
        number is a multiple of the world's chunk.
        """
        ...
