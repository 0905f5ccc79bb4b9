"""Open-loop policies: replay of recorded actions, and holding of the first pose."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float64

from dextouch.clients import PolicyStart
from dextouch.episodes import EpisodeReader
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.hands.actions import check_actions
from dextouch.schemas import CHUNK_STEPS, Observation


class ReplayPolicy:
    """Sends the commanded actions of recorded episodes; as good as their demonstrator.

    They are [T, 67] of steps 1 … T by task and seed, relative to the measured poses of step 0.
    """

    uses_images = False

    def __init__(self, actions: Mapping[tuple[str, int], np.ndarray]) -> None:
        self._actions = {
            (task, seed): check_actions(rows, where=f"replay of {task!r}, seed {seed}")
            for (task, seed), rows in actions.items()
        }
        self._playing: np.ndarray | None = None

    @classmethod
    def of(cls, episodes: Iterable[EpisodeReader]) -> "ReplayPolicy":
        """Policy that replays these robot episodes; their images are not read.

        Raises InvalidInputError for one without a seed, UnknownNameError for one without commanded
        actions, and ConflictError for two of the same task and seed.
        """
        actions: dict[tuple[str, int], np.ndarray] = {}
        for reader in episodes:
            about = reader.attributes
            if about.seed is None:
                raise InvalidInputError(
                    f"episode {about.episode_id!r}: no seed, expected one, as in episodes of the "
                    "twin"
                )
            key = (about.task, about.seed)
            if key in actions:
                raise ConflictError(
                    f"replay policy: two episodes of task {about.task!r} with seed {about.seed}; "
                    "expected one noise level a policy"
                )
            actions[key] = reader.read("action_commanded").values[1:]
        return cls(actions)

    def reset(self, start: PolicyStart) -> None:
        """Select the episode of this task and seed; raises NotFoundError if there is none."""
        key = (start.task, start.seed)
        if key not in self._actions:
            raise NotFoundError(
                f"replay policy: no episode of task {start.task!r} with seed {start.seed}; "
                "record it first"
            )
        self._playing = self._actions[key]

    def act(self, observation: Observation) -> Float64[np.ndarray, "16 67"]:
        """Actions of the steps after the newest one; the last action is repeated at the end."""
        if self._playing is None:
            raise InvalidInputError("replay policy: act before reset; call reset with the start")
        step = observation.first_step + len(observation) - 1
        rows = np.arange(step, step + CHUNK_STEPS)
        return self._playing[np.minimum(rows, len(self._playing) - 1)]


class HoldPolicy:
    """The weakest baseline: keeps the pose of the first observation."""

    uses_images = False

    def __init__(self) -> None:
        self._pose: np.ndarray | None = None

    def reset(self, start: PolicyStart) -> None:
        """Forget the pose of the last rollout; the task is ignored."""
        del start
        self._pose = None

    def act(self, observation: Observation) -> Float64[np.ndarray, "16 67"]:
        """Repeat the pose of the first observation."""
        if self._pose is None:
            self._pose = np.array(observation.action_reached[-1])
        return np.tile(self._pose, (CHUNK_STEPS, 1))
