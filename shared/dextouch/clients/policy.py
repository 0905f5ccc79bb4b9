"""Protocol of policies, which act in any world."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import Observation


@dataclass(frozen=True)
class PolicyStart:
    """Information that a policy gets before its first observation.

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
    worlds need not render them. With `looks = "last"` it may get nothing but the last step of each
    chunk. `tasks` names those it supports; `python -m benchmarks evaluator` skips all others.
    """

    def reset(self, start: PolicyStart) -> None:
        """Reset all state for a new rollout."""
        ...

    def act(self, observation: Observation) -> Float64[np.ndarray, "steps 67"]:
        """The next action chunk, given the observations since the last call (the last step is now).

        Rows are poses and joint angles as commands, relative to the rollout's step 0; their
        number is a multiple of the world's chunk.
        """
        ...
