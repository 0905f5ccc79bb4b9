"""Gymnasium environments of a served world, single and vector; one step is one action chunk.

    name = "dextouch.clients.gym_env:dextouch/Rollout-v0"
    env = gymnasium.make(name, url=url, world="twin", task=…, instruction=…)
    observation, info = env.reset(seed=3)
    observation, reward, terminated, truncated, info = env.step(actions)  # [chunk_steps, 67]

Importing this module, as the first part of the name does, registers the rest of it. `WorldEnv` is
the same for a client of your own.
`WorldVectorEnv` steps several at the same time, so that the service computes them in batches.
Gymnasium's autoreset would draw new starts by itself, but policies are compared from matched ones;
so it is disabled there, and every reset has its seeds. `gymnasium.make_vec` makes one, too.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from typing import Any, Final, TypeVar, cast

import gymnasium
import numpy as np
import structlog
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from jaxtyping import Bool, Float, Float64

from dextouch.clients.rollouts import Rollout, RolloutClient
from dextouch.errors import EndedError, InvalidInputError, UnavailableError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM, POSE_SLICES
from dextouch.schemas import Observation, WorldDescription

logger = structlog.get_logger(__name__)

# Bounds of the action space. They limit its samples, not what worlds accept.
MAX_REACH_M = 2.0
MAX_JOINT_RAD = np.pi
ENV_ID: Final = "dextouch/Rollout-v0"
# Gymnasium requires finite bounds; no sensor comes near these.
MAX_TACTILE_KPA = 1e6
MAX_REACHED = 1e6

SeenNow = dict[str, Any]
ResultT = TypeVar("ResultT")


class WorldEnv(gymnasium.Env[SeenNow, np.ndarray]):
    """One task in one served world; an action is `chunk_steps` model steps.

    The observation is that of the newest step: `tactile_kpa` [2, taxels], `action_reached` [67] and
    one image a camera that the client selects. The reward is 1 on the chunk that ends in success,
    else 0; success ends the episode, `max_chunks` truncates it. A world without a success check
    never terminates. A world that cannot continue a rollout truncates it: the observation is then
    the last one again, and `info["ended"]` says why (None otherwise). `info` also holds `success`
    (None where unknown), `uncertainty` of the chunk, `rollout_uncertainty` of all chunks so far,
    and the numbers that the world reports about the chunk.

    With the render mode `rgb_array`, `render` returns the newest image of each camera side by side,
    [h, w, 3]; with `rgb_array_list`, all of the newest chunk, and none the second time.
    """

    # Of the usual chunk; an instance has the rate of its own world and chunks.
    metadata: dict[str, Any] = {  # noqa: RUF012 - as gymnasium declares it
        "render_modes": ["rgb_array", "rgb_array_list"],
        "render_fps": 15 / 16,
    }

    def __init__(  # noqa: PLR0913 - all by name
        self,
        client: RolloutClient,
        *,
        world: str,
        task: str,
        instruction: str,
        chunk_steps: int = 16,
        max_chunks: int = 5,
        render_mode: str | None = None,
    ) -> None:
        self.client = client
        self._rollout: Rollout | None = None
        self._task = task
        self._instruction = instruction
        self._max_chunks = max_chunks
        described = {one.name: one for one in client.worlds()}
        if world not in described:
            raise UnknownNameError("world", world, list(described))
        self.description = described[world]
        chosen = client.selector.cameras
        self._cameras = self.description.cameras if chosen is None else tuple(dict.fromkeys(chosen))
        if chunk_steps < 1 or chunk_steps % self.description.chunk_multiple:
            raise InvalidInputError(
                f"chunk_steps: got {chunk_steps}, expected a positive multiple of "
                f"{self.description.chunk_multiple}"
            )
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise UnknownNameError("render mode", render_mode, modes)
        if render_mode is not None and not self._cameras:
            raise InvalidInputError(f"render_mode: world {world} has no camera, expected None")
        self.render_mode = render_mode
        rate_hz = self.description.model_rate_hz
        per_image = 1 if render_mode == "rgb_array_list" else chunk_steps
        self.metadata = {**self.metadata, "render_fps": rate_hz / per_image}
        self._rendered: Observation | None = None
        self.observation_space = _observation_space(self.description, self._cameras)
        self.action_space = _action_space(chunk_steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[SeenNow, dict[str, Any]]:
        """Start a new rollout; without a seed of the start and the world's noise one is drawn.

        The options {"init": (observation, anchor, K_head)} start from an observation.
        """
        super().reset(seed=seed)
        unknown = sorted(set(options or {}) - {"init"})
        if unknown:
            raise UnknownNameError("reset option", unknown[0], ["init"])
        start_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self._end()
        init = (options or {}).get("init")
        self._rollout = self.client.start(
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

    def render(self) -> Any:  # noqa: ANN401 - an image or a list of images, by the mode
        """The newest images as the render mode says; None without one."""
        if self.render_mode is None:
            return None
        if self._rollout is None:
            raise InvalidInputError("render: there is no episode; call reset first")
        seen = self._rollout.observation
        images = np.concatenate([seen.images[name] for name in self._cameras], axis=2)
        if self.render_mode == "rgb_array":
            return images[-1]
        is_rendered, self._rendered = seen is self._rendered, seen
        return [] if is_rendered else list(images)

    def close(self) -> None:
        """End the running rollout; the client stays open."""
        self._end()

    def _end(self) -> None:
        rollout, self._rollout = self._rollout, None
        if rollout is not None:
            try:
                rollout.close()
            except UnavailableError as error:
                # The service ends rollouts that nobody uses, or is gone with them.
                logger.warning("rollout_not_closed", rollout=rollout.id, error=error.message)

    @staticmethod
    def _info(rollout: Rollout) -> dict[str, Any]:
        return {
            "success": rollout.observation.success,
            "last_step": rollout.info.last_step,
            "reported": dict(rollout.reported),
            "uncertainty": rollout.observation.uncertainty,
            "rollout_uncertainty": rollout.info.rollout_uncertainty,
            "ended": None,
        }


class RolloutEnv(WorldEnv):
    """`WorldEnv` with a client of its own, as `gymnasium.make("dextouch/Rollout-v0")` makes it."""

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        **options: Any,  # noqa: ANN401 - as WorldEnv
    ) -> None:
        with ExitStack() as opened:
            super().__init__(opened.enter_context(RolloutClient(url, api_key=api_key)), **options)
            opened.pop_all()

    def close(self) -> None:
        """End the running rollout, and close the client."""
        with self.client:
            super().close()


def make_vector(
    *,
    num_envs: int,
    **options: Any,  # noqa: ANN401 - as RolloutEnv
) -> "WorldVectorEnv":
    """Environments with clients of their own, as `gymnasium.make_vec` makes them."""
    with ExitStack() as opened:
        envs = [opened.enter_context(closing(RolloutEnv(**options))) for _ in range(num_envs)]
        vector = WorldVectorEnv(envs)
        opened.pop_all()
    return vector


if ENV_ID not in gymnasium.registry:
    gymnasium.register(
        ENV_ID,
        entry_point=f"{__name__}:{RolloutEnv.__name__}",
        vector_entry_point=f"{__name__}:{make_vector.__name__}",
    )


class WorldVectorEnv(VectorEnv[SeenNow, np.ndarray, np.ndarray]):
    """Several environments of a served world that step at the same time.

    Autoreset is disabled: once an episode has ended, its environment must be reset before the next
    step, by `options={"reset_mask": terminations | truncations}`. If a reset or a step raises, some
    environments may have done it and others not; reset all of them. Spaces are equal, and each has
    a client of its own, which is not thread-safe; they are closed with this one, clients of a
    `WorldEnv` are not.
    """

    def __init__(self, envs: Sequence[WorldEnv]) -> None:
        first = envs[0]
        if len({id(env.client) for env in envs}) < len(envs):
            raise InvalidInputError("envs: two have the same client, expected one for each")
        for env in envs:
            if (env.observation_space, env.action_space) != (
                first.observation_space,
                first.action_space,
            ):
                raise InvalidInputError("envs: their spaces differ, expected equal ones")
        self.metadata = {**first.metadata, "autoreset_mode": AutoresetMode.DISABLED}
        self.render_mode = first.render_mode
        self.num_envs = len(envs)
        self.single_observation_space = first.observation_space
        self.single_action_space = first.action_space
        self.observation_space = batch_space(first.observation_space, self.num_envs)
        self.action_space = batch_space(first.action_space, self.num_envs)
        self._envs = envs
        self._threads = ThreadPoolExecutor(self.num_envs, "world_env")
        self._seen: list[SeenNow] = [{}] * self.num_envs
        self._needs_reset = np.ones(self.num_envs, bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[SeenNow, dict[str, Any]]:
        """Start new rollouts; the seed of the first counts up for the others, or each has its own.

        The options {"reset_mask": bool array [num_envs]} leave the others as they are; {"inits":
        sequence} start each from its own (observation, anchor, K_head).
        """
        rest = dict(options or {})
        chosen = self._chosen(rest.pop("reset_mask", None))
        inits = rest.pop("inits", None)
        if rest:
            raise UnknownNameError("reset option", sorted(rest)[0], ["inits", "reset_mask"])
        seeds = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
        for name, values in (("seed", seeds), ("inits", inits)):
            if values is not None and len(values) != self.num_envs:
                raise InvalidInputError(f"{name}: got {len(values)}, expected {self.num_envs}")

        def begin(i: int) -> tuple[SeenNow, dict[str, Any]]:
            options = None if inits is None else {"init": inits[i]}
            return self._envs[i].reset(seed=None if seeds is None else seeds[i], options=options)

        self._needs_reset[chosen] = True
        infos: dict[str, Any] = {}
        for i, (seen, info) in zip(chosen, self._together(begin, chosen), strict=True):
            self._seen[i] = seen
            infos = self._add_info(infos, info, i)
        self._needs_reset[chosen] = False
        return self._batch(), infos

    def step(
        self, actions: Float[np.ndarray, "envs steps 67"]
    ) -> tuple[
        SeenNow,
        Float64[np.ndarray, " envs"],
        Bool[np.ndarray, " envs"],
        Bool[np.ndarray, " envs"],
        dict[str, Any],
    ]:
        """Advance every environment by one chunk, relative to its start's poses."""
        if self._needs_reset.any():
            raise InvalidInputError(
                f"step: environments {np.flatnonzero(self._needs_reset).tolist()} have no episode; "
                "reset them first, with options={'reset_mask': …}"
            )
        if len(actions) != self.num_envs:
            raise InvalidInputError(f"actions: got {len(actions)} chunks, expected {self.num_envs}")
        self._needs_reset[:] = True
        every = range(self.num_envs)
        results = self._together(lambda i: self._envs[i].step(actions[i]), every)
        self._seen, rewards, terminated, truncated, each = map(list, zip(*results, strict=True))
        infos: dict[str, Any] = {}
        for i, info in enumerate(each):
            infos = self._add_info(infos, info, i)
        self._needs_reset = np.logical_or(terminated, truncated)
        return self._batch(), np.array(rewards), np.array(terminated), np.array(truncated), infos

    def render(self) -> tuple[Any, ...]:
        """What each environment renders."""
        return tuple(env.render() for env in self._envs)

    def close_extras(self) -> None:
        """End the running rollouts."""
        with self._threads:
            self._together(lambda i: self._envs[i].close(), range(self.num_envs))

    def _chosen(self, mask: object) -> list[int]:
        if mask is None:
            return list(range(self.num_envs))
        array = np.asarray(mask)
        if array.shape != (self.num_envs,) or array.dtype != bool or not array.any():
            raise InvalidInputError(
                f"reset_mask: got {mask!r}, expected {self.num_envs} booleans, one of them true"
            )
        if not all(self._seen[i] for i in np.flatnonzero(~array)):
            raise InvalidInputError("reset_mask: expected none at the first reset")
        return [int(i) for i in np.flatnonzero(array)]

    def _together(self, call: Callable[[int], ResultT], chosen: Iterable[int]) -> list[ResultT]:
        """Call with each index in a thread of its own; raises the first error once all are done."""
        pending = [self._threads.submit(call, i) for i in chosen]
        errors = [future.exception() for future in pending]
        for error in filter(None, errors):
            raise error
        return [future.result() for future in pending]

    def _batch(self) -> SeenNow:
        empty = cast(SeenNow, create_empty_array(self.single_observation_space, self.num_envs))
        return dict(concatenate(self.single_observation_space, self._seen, empty))


def _observation_space(
    description: WorldDescription, cameras: Sequence[str]
) -> spaces.Space[SeenNow]:
    shape = (description.image_height_px, description.image_width_px, 3)
    parts: dict[str, spaces.Space[Any]] = {
        camera: spaces.Box(0, 255, shape, np.uint8) for camera in cameras
    }
    touch = (2, description.num_taxels)
    parts["tactile_kpa"] = spaces.Box(-MAX_TACTILE_KPA, MAX_TACTILE_KPA, touch, np.float32)
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
