"""Replay of an episode's actions in the twin and in the world model at once, step by step."""

import asyncio
import secrets
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Literal
from urllib.parse import quote, urlencode

import numpy as np
import structlog
from pydantic import Field

from dextouch import schemas
from dextouch.errors import DexTouchError, EndedError, InvalidInputError, NotFoundError
from dextouch.frozen_model import FrozenModel, example
from dextouch.metrics import tactile
from dextouch.serving import MSGPACK, OCTETS
from dextouch.streams import HEAD_CAMERA, unpack
from dextouch.tactile import in_contact
from services.dashboard.feeds import Feeds, Topic
from services.dashboard.rollout_feeds import MAX_RESPONSE_BYTES, packed_message

logger = structlog.get_logger(__name__)

MAX_STEPS: Final = 640
# Of the images of both worlds that are kept for the page.
MAX_KEPT_BYTES: Final = 64 * 2**20
WORLD_TIMEOUT_S: Final = 120.0
COMPARISON_MESSAGE: Final = 3
SERVICES: Final = {"real": "twin", "imagined": "world_model"}


class StartComparison(FrozenModel):
    """Body of POST /v1/comparisons: an episode of the store, recorded in the twin."""

    model_config = example(episode_id="take-20260301-1")

    episode_id: str = Field(pattern=schemas.ID_PATTERN)


class ChunkUncertainty(FrozenModel):
    """What the imagining world says about one chunk; None where it reports no uncertainty."""

    first_step: int
    last_step: int
    uncertainty: schemas.Uncertainty | None


class ComparisonView(FrozenModel):
    """State of a comparison; the errors are of steps 0, 1, 2, …, which are all computed so far.

    `pixel_error` is the mean absolute difference of the head images, 0 … 255, `pressure_error_kpa`
    that of the taxels of both hands; `contact_f1` of the taxels in contact is 1 where neither world
    has any.
    """

    id: str = ""
    state: Literal["none", "running", "finished", "stopped", "failed"] = "none"
    note: str = ""
    episode_id: str = ""
    task: str = ""
    instruction: str = ""
    seed: int = 0
    worlds: dict[str, str] = Field(default={})
    rate_hz: float = 15.0
    num_steps: int = 0
    num_chunks: int = 0
    real_success: bool | None = None
    pixel_error: tuple[float, ...] = ()
    pressure_error_kpa: tuple[float, ...] = ()
    contact_f1: tuple[float, ...] = ()
    in_contact: tuple[bool, ...] = ()
    uncertainties: tuple[ChunkUncertainty, ...] = ()


@dataclass
class _Side:
    """One world of a comparison: its service, and its rollout once begun."""

    service: str
    world: schemas.WorldDescription
    rollout_id: str = ""


@dataclass
class _Run:
    view: ComparisonView
    messages: list[bytes] = field(default_factory=list)
    task: "asyncio.Task[None] | None" = None


class Comparisons:
    """Runs one comparison at a time; a new one ends the one before."""

    def __init__(self, feeds: Feeds, *, period_s: float) -> None:
        self._feeds = feeds
        self._run = _Run(ComparisonView())
        self.topics = {"comparison": Topic.of_json("comparison", period_s, self.newest)}

    async def newest(self) -> ComparisonView:
        """The running or newest comparison."""
        return self._run.view

    async def start(self, episode_id: str) -> ComparisonView:
        """Replay an episode of the store.

        Raises:
            NotFoundError: no such episode, or a service is not configured.
            InvalidInputError: an episode that cannot be replayed in these worlds.
            UnavailableError: a service does not answer.
        """
        sides = {side: await self._world(service) for side, service in SERVICES.items()}
        about, actions = await self._episode(episode_id)
        _check_worlds(sides, about.attributes.task)
        chunk = sides["imagined"].world.chunk_multiple
        step_bytes = (
            2 * 3 * sides["real"].world.image_height_px * sides["real"].world.image_width_px
        )
        allowed = min(MAX_STEPS, MAX_KEPT_BYTES // step_bytes, len(actions)) // chunk * chunk
        if not allowed:
            raise InvalidInputError(
                f"episode {episode_id!r}: got {len(actions)} actions, expected at least {chunk}"
            )
        await self.stop()
        view = ComparisonView(
            id=secrets.token_hex(8),
            state="running",
            episode_id=episode_id,
            task=about.attributes.task,
            instruction=about.attributes.instruction,
            seed=about.attributes.seed or 0,
            worlds={side: one.world.name for side, one in sides.items()},
            rate_hz=sides["real"].world.model_rate_hz,
            num_steps=allowed,
        )
        self._run = run = _Run(view)
        run.task = asyncio.create_task(self._supervise(run, sides, actions[:allowed]))
        return view

    def chunk(self, comparison_id: str, number: int) -> bytes:
        """Images and touch of both worlds over one chunk; chunk 0 is the start.

        Raises:
            NotFoundError: another comparison has begun, or there is no such chunk yet.
        """
        run = self._run
        if comparison_id != run.view.id or not 0 <= number < len(run.messages):
            raise NotFoundError(
                f"comparison {comparison_id!r}, chunk {number}: not there; the newest comparison "
                f"is {run.view.id!r} with {len(run.messages)} chunks",
                got=comparison_id,
            )
        return run.messages[number]

    async def stop(self) -> None:
        """End the running comparison, if any; its rollouts are ended too."""
        task = self._run.task
        if task is not None and not task.done():
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def _world(self, service: str) -> _Side:
        wanted = {"twin": "twin", "world_model": "model"}[service]
        upstream = self._feeds.upstream(service)
        worlds = (await upstream.read(schemas.WorldList, "/v1/worlds")).worlds
        found = [one for one in worlds if one.kind == wanted]
        if not found:
            names = ", ".join(f"{one.name} ({one.kind})" for one in worlds)
            raise InvalidInputError(f"{service}: got {names}, expected a world of kind {wanted}")
        return _Side(service, found[0])

    async def _episode(self, episode_id: str) -> tuple[schemas.EpisodeDetail, np.ndarray]:
        store, path = self._feeds.upstream("episode_store"), f"/v1/episodes/{quote(episode_id)}"
        about = await store.read(schemas.EpisodeDetail, path)
        attributes = about.attributes
        if attributes.seed is None or attributes.domain != "robot":
            raise InvalidInputError(
                f"episode {episode_id!r}: {attributes.domain}, seed {attributes.seed}; expected a "
                "robot episode with a seed, as the twin and studies record them: the twin places "
                "its objects by it"
            )
        answer = await store.send("GET", f"{path}/streams/action_commanded")
        _, arrays = unpack(answer.content, max_bytes=MAX_RESPONSE_BYTES)
        # Row 0 holds the poses of the start.
        return about, np.asarray(arrays["values"], np.float64)[1:]

    async def _supervise(self, run: _Run, sides: Mapping[str, _Side], actions: np.ndarray) -> None:
        state: Literal["finished", "stopped", "failed"] = "finished"
        note = ""
        try:
            await self._play(run, sides, actions)
        except EndedError as error:
            note = f"The world model ended its rollout: {error.reason}"
        except asyncio.CancelledError:
            state = "stopped"
        except DexTouchError as error:
            state, note = "failed", error.message
        except Exception as error:
            # Supervisor of a job: the page shows that it failed, the log why.
            logger.exception("comparison_failed", episode_id=run.view.episode_id)
            state, note = "failed", f"{type(error).__name__}; see the dashboard's log"
        run.view = run.view.model_copy(update={"state": state, "note": note})
        for side in sides.values():
            if side.rollout_id:
                with suppress(DexTouchError):
                    path = f"/v1/rollouts/{side.rollout_id}"
                    await self._feeds.upstream(side.service).send("DELETE", path)

    async def _play(self, run: _Run, sides: Mapping[str, _Side], actions: np.ndarray) -> None:
        real, imagined = sides["real"], sides["imagined"]
        first = await self._start(run, real, None)
        begun = await self._start(run, imagined, first)
        await self._add(run, first.observation, begun.observation)
        size = min(schemas.CHUNK_STEPS, *(one.world.max_chunk_steps for one in sides.values()))
        for number, start in enumerate(range(0, len(actions), size)):
            rows = actions[start : start + size]
            truth, guess = await asyncio.gather(
                self._step(real, number, rows), self._step(imagined, number, rows)
            )
            await self._add(run, truth.observation, guess.observation)

    async def _start(
        self, run: _Run, side: _Side, first: schemas.RolloutAnswer | None
    ) -> schemas.RolloutAnswer:
        view = run.view
        request = schemas.StartRequest(
            world=side.world.name, task=view.task, seed=view.seed, instruction=view.instruction
        )
        start = schemas.start_from(request)
        if first is not None:
            start = schemas.start_from(request, observation=first.observation, origin=first.origin)
        body = schemas.encode_start(request, start)
        answer = await self._post(side, "/v1/rollouts", MSGPACK, body)
        side.rollout_id = answer.rollout.id
        return answer

    async def _step(self, side: _Side, number: int, rows: np.ndarray) -> schemas.RolloutAnswer:
        path = f"/v1/rollouts/{side.rollout_id}/chunks/{number}"
        return await self._post(
            side, path, f"{OCTETS}; dtype=float64", rows.astype("<f8").tobytes()
        )

    async def _post(self, side: _Side, path: str, kind: str, body: bytes) -> schemas.RolloutAnswer:
        headers = {"content-type": kind, "accept": MSGPACK, "dextouch-client": "replay"}
        path = f"{path}?{urlencode({'cameras': HEAD_CAMERA})}"
        upstream = self._feeds.upstream(side.service)
        answer = await upstream.forward("POST", path, headers, body, timeout_s=WORLD_TIMEOUT_S)
        return schemas.decode_answer(answer.content, max_bytes=MAX_RESPONSE_BYTES)

    async def _add(
        self, run: _Run, real: schemas.Observation, imagined: schemas.Observation
    ) -> None:
        """Add the steps of a chunk: their errors to the view, their images for the page."""
        added, message = await asyncio.to_thread(compared, real, imagined)
        run.messages.append(message)
        view = run.view
        joined = {name: getattr(view, name) + values for name, values in added.items()}
        unreliable = ChunkUncertainty(
            first_step=real.first_step,
            last_step=real.first_step + len(real) - 1,
            uncertainty=imagined.uncertainty,
        )
        run.view = view.model_copy(
            update=joined
            | {
                "num_chunks": len(run.messages),
                "real_success": real.success,
                # The start is given, not imagined.
                "uncertainties": (*view.uncertainties, unreliable)
                if real.first_step
                else view.uncertainties,
            }
        )


def compared(
    real: schemas.Observation, imagined: schemas.Observation
) -> tuple[dict[str, tuple[Any, ...]], bytes]:
    """Errors of every step, and the message with both worlds' images and touch.

    The message is laid out as that of `steps_message`, with the real world first in every array:
    touch [2, steps, 2, num_taxels] and images [2, steps, height, width, 3].
    """
    images = [seen.images[HEAD_CAMERA] for seen in (real, imagined)]
    touch = [seen.tactile_kpa for seen in (real, imagined)]
    apart = np.abs(images[0].astype(np.int16) - images[1])
    pairs = list(zip(*touch, strict=True))
    errors = {
        "pixel_error": tuple(apart.mean(axis=(1, 2, 3)).tolist()),
        "pressure_error_kpa": tuple(
            tactile.mae(predicted_kpa=guess, true_kpa=truth) for truth, guess in pairs
        ),
        "contact_f1": tuple(
            tactile.contact_f1(predicted_kpa=guess, true_kpa=truth) for truth, guess in pairs
        ),
        "in_contact": tuple(
            bool(in_contact(truth).any() or in_contact(guess).any()) for truth, guess in pairs
        ),
    }
    _, height, width, _ = images[0].shape
    header = {"first_step": real.first_step, "num_steps": len(real)}
    header |= {"height": height, "width": width, "num_taxels": touch[0].shape[-1]}
    parts = [np.ascontiguousarray(np.stack(touch), "<f4").tobytes(), np.stack(images).tobytes()]
    return errors, packed_message(COMPARISON_MESSAGE, header, parts)


def _check_worlds(sides: Mapping[str, _Side], task: str) -> None:
    """Refuse worlds that cannot be compared step by step."""
    for one in sides.values():
        if task not in one.world.tasks:
            raise InvalidInputError(
                f"world {one.world.name}: got task {task!r}, expected one of "
                f"{', '.join(one.world.tasks)}"
            )
    real, imagined = (
        (one.world.image_height_px, one.world.image_width_px, one.world.model_rate_hz)
        for one in (sides["real"], sides["imagined"])
    )
    if real != imagined:
        raise InvalidInputError(
            f"worlds: got images of {real[0]} by {real[1]} px at {real[2]:g} Hz and of "
            f"{imagined[0]} by {imagined[1]} px at {imagined[2]:g} Hz, expected the same; start "
            "the twin with the world model's image size"
        )
    gloves = {name: one.world.tactile_layout for name, one in sides.items()}
    others = {name: glove.name for name, glove in gloves.items() if glove is not None}
    if others:
        # The twin has no other glove to compare with.
        raise InvalidInputError(
            f"worlds: got the tactile layouts {others}, expected dextouch_v1 in both; only its "
            "taxels can be compared"
        )
