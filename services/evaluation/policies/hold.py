"""Hold policy: keeps the hands where they are; the weakest baseline."""

import numpy as np
from jaxtyping import Float64

from dextouch.clients import PolicyStart
from dextouch.errors import InvalidInputError
from dextouch.schemas import Observation


class HoldPolicy:
    """Keeps the pose of the first observation.

    Args:
        chunk_steps: length of its chunks, a multiple of 4.
    """

    looks = False

    def __init__(self, *, chunk_steps: int = 16) -> None:
        if chunk_steps < 4 or chunk_steps % 4:
            raise InvalidInputError(
                f"hold policy: got chunks of {chunk_steps} steps, expected a multiple of 4"
            )
        self.chunk_steps = chunk_steps
        self._pose: np.ndarray | None = None

    def reset(self, start: PolicyStart) -> None:
        """Forget the pose of the last rollout; the task is ignored."""
        del start
        self._pose = None

    def act(self, observation: Observation) -> Float64[np.ndarray, "steps 67"]:
        """Repeat the pose of the first observation."""
        if self._pose is None:
            self._pose = np.array(observation.action_reached[-1])
        return np.tile(self._pose, (self.chunk_steps, 1))
