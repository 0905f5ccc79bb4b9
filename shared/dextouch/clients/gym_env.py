"""Gymnasium environment of a served world; one environment step is one action chunk.

    env = WorldEnv(RolloutClient(url), world="twin", task="stand_bottle", instruction="…")
    observation, info = env.reset(seed=3)
    observation, reward, terminated, truncated, info = env.step(actions)  # [chunk_steps, 67]

Gymnasium's autoreset draws a new start by itself; to compare policies from matched starts use
`AutoresetMode.DISABLED` and a seed for every reset.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from dextouch.clients.rollouts import Rollout, RolloutClient
from dextouch.errors import EndedError, InvalidInputError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM, POSE_SLICES
from dextouch.schemas import Observation, WorldDescription

# Bounds of the action space. They limit its samples, not what worlds accept.
MAX_REACH_M = 2.0
MAX_JOINT_RAD = np.pi
# Gymnasium requires finite bounds; no sensor comes near these.
MAX_TACTILE_KPA = 1e6
MAX_REACHED = 1e6

SeenNow = dict[str, Any]


class WorldEnv(gymnasium.Env[SeenNow, np.ndarray]):
    """One task in one served world.

    The observation is that of the newest step: `tactile_kpa` [2, 320], `action_reached` [67] and
    one image a camera. The reward is 1 on the chunk that ends in success, else 0; success ends the
    episode, `max_chunks` truncates it. A world without a success check never terminates. A world
    that cannot continue a rollout truncates it: the observation is then the last one again, and
    `info["ended"]` says why (None otherwise). `info` also holds `success` (None where unknown),
    `doubt` and the numbers that the world reports about the chunk.

    Args:
        client: of the service.
        world: its name at the service.
        task: one of the world's.
        instruction: in words.
        chunk_steps: model steps of an action, a multiple of the world's chunk.
        max_chunks: number of chunks after which the episode is truncated.
    """

    def __init__(
        self,
        client: RolloutClient,
        *,
        world: str,
        task: str,
        instruction: str,
        chunk_steps: int = 16,
        max_chunks: int = 5,
    ) -> None:
        self.metadata = {"render_modes": []}
        self._client = client
        self._rollout: Rollout | None = None
        self._task = task
        self._instruction = instruction
        self._max_chunks = max_chunks
        described = {one.name: one for one in client.worlds()}
        if world not in described:
            raise UnknownNameError("world", world, list(described))
        self.description = described[world]
        if chunk_steps < 1 or chunk_steps % self.description.chunk_multiple:
            raise InvalidInputError(
                f"chunk_steps: got {chunk_steps}, expected a positive multiple of "
                f"{self.description.chunk_multiple}"
            )
        self.observation_space = _observation_space(self.description)
        self.action_space = _action_space(chunk_steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[SeenNow, dict[str, Any]]:
        """Start a new rollout.

        Args:
            seed: of the start and the world's noise; None draws one.
            options: {"init": (observation, anchor, K_head)} starts from an observation.
        """
        super().reset(seed=seed)
        unknown = sorted(set(options or {}) - {"init"})
        if unknown:
            raise UnknownNameError("reset option", unknown[0], ["init"])
        start_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self.close()
        init = (options or {}).get("init")
        self._rollout = self._client.start(
            world=self.description.name,
            task=self._task,
            seed=start_seed,
            instruction=self._instruction,
            init=init,
        )
        return _seen_now(self._rollout.observation), self._info(self._rollout)

    def step(self, action: np.ndarray) -> tuple[SeenNow, float, bool, bool, dict[str, Any]]:
        """Advance by one chunk [chunk_steps, 67], relative to the start's poses."""
        if self._rollout is None:
            raise InvalidInputError("step: there is no episode; call reset first")
        try:
            observation = self._rollout.step(action)
        except EndedError as error:
            info = self._info(self._rollout) | {"ended": error.reason}
            return _seen_now(self._rollout.observation), 0.0, False, True, info
        success = observation.success is True
        truncated = not success and self._rollout.info.next_chunk >= self._max_chunks
        info = self._info(self._rollout)
        return _seen_now(observation), float(success), success, truncated, info

    def close(self) -> None:
        """End the running rollout; the client stays open."""
        if self._rollout is not None:
            self._rollout.close()
            self._rollout = None

    @staticmethod
    def _info(rollout: Rollout) -> dict[str, Any]:
        return {
            "success": rollout.observation.success,
            "last_step": rollout.info.last_step,
            "told": dict(rollout.told),
            "doubt": rollout.observation.doubt,
            "ended": None,
        }


def _observation_space(description: WorldDescription) -> spaces.Space[SeenNow]:
    shape = (description.image_height_px, description.image_width_px, 3)
    parts: dict[str, spaces.Space[Any]] = {
        camera: spaces.Box(0, 255, shape, np.uint8) for camera in description.cameras
    }
    parts["tactile_kpa"] = spaces.Box(-MAX_TACTILE_KPA, MAX_TACTILE_KPA, (2, 320), np.float32)
    parts["action_reached"] = spaces.Box(-MAX_REACHED, MAX_REACHED, (ACTION_DIM,), np.float64)
    return spaces.Dict(parts)


def _action_space(chunk_steps: int) -> spaces.Box:
    high = np.full(ACTION_DIM, MAX_JOINT_RAD)
    for part in POSE_SLICES:
        high[part] = [MAX_REACH_M] * 3 + [1.0] * 6
    rows = np.tile(high, (chunk_steps, 1))
    return spaces.Box(-rows, rows, dtype=np.float64)


def _seen_now(observation: Observation) -> SeenNow:
    now = {camera: images[-1].copy() for camera, images in observation.images.items()}
    now["tactile_kpa"] = observation.tactile_kpa[-1].copy()
    now["action_reached"] = observation.action_reached[-1].copy()
    return now
