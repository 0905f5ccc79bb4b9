"""Real against imagined, step by step: actions of an episode, or of hands moved on the page."""

import asyncio
import secrets
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import lcm
from typing import Any, Final, Literal
from urllib.parse import quote

import numpy as np
import structlog
from pydantic import Field

from dextouch import schemas
from dextouch.errors import DexTouchError, EndedError, InvalidInputError, NotFoundError
from dextouch.frozen_model import FrozenModel, example
from dextouch.metrics import tactile
from dextouch.streams import HEAD_CAMERA, unpack
from dextouch.tactile import in_contact
from services.dashboard.comparison_sides import RecordedSide, Side, WorldSide, fitted
from services.dashboard.feeds import Feeds, Topic
from services.dashboard.hand_driving import HandDriver, Moves
from services.dashboard.rollout_feeds import MAX_RESPONSE_BYTES, packed_message

logger = structlog.get_logger(__name__)

MAX_STEPS: Final = 640
# Of the images of both worlds that are kept for the page.
MAX_KEPT_BYTES: Final = 64 * 2**20
COMPARISON_MESSAGE: Final = 3
SERVICES: Final = {"real": ("twin", "twin"), "imagined": ("world_model", "model")}
# Of hands that nobody moves.
LEASE_S: Final = 120.0


class StartComparison(FrozenModel):
    """Body of POST /v1/comparisons: an episode of the store, or where to move hands."""

    model_config = example(episode_id="take-20260301-1")

    episode_id: str = Field(default="", pattern=f"{schemas.ID_PATTERN}|^$")
    task: str = Field(default="", max_length=128)
    seed: int = Field(default=0, ge=0, le=schemas.MAX_SEED)


class ChunkUncertainty(FrozenModel):
    """What the imagining world says about one chunk; None where it reports no uncertainty.

    `bound_share` is the largest of its figures as a share of that figure's bound.
    """

    first_step: int
    last_step: int
    uncertainty: schemas.Uncertainty | None
    bound_share: float | None = None


class ComparisonView(FrozenModel):
    """State of a comparison; the errors are of steps 0, 1, 2, …, which are all computed so far.

    `pixel_error` is the mean absolute difference of the head images, 0 … 255, `pressure_error_kpa`
    that of the taxels of both hands; `contact_f1` of the taxels in contact is 1 where neither world
    has any. Without an `episode_id` hands are moved by a person.
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
class _Run:
    view: ComparisonView
    sides: Mapping[str, Side] = field(default_factory=dict)
    messages: list[bytes] = field(default_factory=list)
    # Of a person who moves hands, each with an event that is set once they were made.
    moves: asyncio.Queue[tuple[Moves, asyncio.Event]] = field(default_factory=asyncio.Queue)
    task: "asyncio.Task[None] | None" = None


class Comparisons:
    """Runs one comparison at a time; a new one ends the one before."""

    def __init__(self, feeds: Feeds, *, period_s: float) -> None:
        self._feeds = feeds
        self._run = _Run(ComparisonView())
        # Held while a run ends, and until the next one is in its place.
        self._ending = asyncio.Lock()
        self.topics = {"comparison": Topic.of_json("comparison", period_s, self.newest)}

    async def newest(self) -> ComparisonView:
        """The running or newest comparison."""
        return self._run.view

    async def start(self, request: StartComparison) -> ComparisonView:
        """Replay an episode of the store, or begin with hands that wait to be moved.

        Raises:
            NotFoundError: no such episode, or a service is not configured.
            InvalidInputError: an episode that cannot be replayed in these worlds, or no task.
            UnavailableError: a service does not answer.
        """
        imagined = await self._world("imagined")
        actions, real, view = None, None, ComparisonView(task=request.task, seed=request.seed)
        if request.episode_id:
            about, actions = await self._episode(request.episode_id)
            known = ("episode_id", "task", "instruction")
            changes: dict[str, Any] = {name: getattr(about, name) for name in known}
            view = view.model_copy(update=changes | {"seed": about.seed or 0})
            if about.seed is None:
                store = self._feeds.upstream("episode_store")
                real = RecordedSide(store, about, len(actions) + 1)
        sides: dict[str, Side] = {"real": real or await self._world("real"), "imagined": imagined}
        _check_worlds(_worlds(sides), view.task)
        world = imagined.world
        chunk, step_bytes = _chunk_steps(sides), 6 * world.image_height_px * world.image_width_px
        most = min(MAX_STEPS, MAX_KEPT_BYTES // step_bytes)
        allowed = (most if actions is None else min(most, len(actions))) // chunk * chunk
        if actions is not None and not allowed:
            raise InvalidInputError(
                f"episode {request.episode_id!r}: got {len(actions)} actions, expected at least "
                f"{chunk}"
            )
        changes = {
            "id": secrets.token_hex(8),
            "state": "running",
            "worlds": {side: one.name for side, one in sides.items()},
            "rate_hz": world.model_rate_hz,
            "num_steps": allowed,
        }
        run = _Run(view.model_copy(update=changes), sides)
        async with self._ending:
            await self._end()
            self._run = run
            run.task = asyncio.create_task(self._supervise(run, actions))
        return run.view

    async def move(self, comparison_id: str, moves: Moves) -> ComparisonView:
        """Move the hands for one chunk, and return the comparison after it.

        Raises:
            NotFoundError: no running comparison of this id whose hands can be moved.
        """
        run = self._run
        if comparison_id != run.view.id or run.view.episode_id or run.view.state != "running":
            raise NotFoundError(
                f"comparison {comparison_id!r}: it is over, or hands cannot be moved in it; start "
                "another one",
                got=comparison_id,
            )
        made = asyncio.Event()
        run.moves.put_nowait((moves, made))
        waiting = asyncio.create_task(made.wait())
        ends: set[asyncio.Task[Any]] = {waiting} | ({run.task} if run.task else set())
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        return run.view

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
        async with self._ending:
            await self._end()

    async def _end(self) -> None:
        run = self._run
        if run.task is not None:
            # One that is over ends its rollouts, for which it is only waited.
            if run.view.state == "running":
                run.task.cancel()
            with suppress(asyncio.CancelledError):
                await run.task

    async def _world(self, side: str) -> WorldSide:
        service, wanted = SERVICES[side]
        upstream = self._feeds.upstream(service)
        worlds = (await upstream.read(schemas.WorldList, "/v1/worlds")).worlds
        found = [one for one in worlds if one.kind == wanted]
        if not found:
            names = ", ".join(f"{one.name} ({one.kind})" for one in worlds)
            raise InvalidInputError(f"{service}: got {names}, expected a world of kind {wanted}")
        return WorldSide(upstream, found[0])

    async def _episode(self, episode_id: str) -> tuple[schemas.EpisodeAttributes, np.ndarray]:
        store, path = self._feeds.upstream("episode_store"), f"/v1/episodes/{quote(episode_id)}"
        about = (await store.read(schemas.EpisodeDetail, path)).attributes
        if about.domain != "robot":
            raise InvalidInputError(
                f"episode {episode_id!r}: got domain {about.domain}, expected robot, whose "
                "commands can be sent to worlds"
            )
        answer = await store.send("GET", f"{path}/streams/action_commanded")
        _, arrays = unpack(answer.content, max_bytes=MAX_RESPONSE_BYTES)
        # Row 0 holds the poses of the start.
        return about, np.asarray(arrays["values"], np.float64)[1:]

    async def _supervise(self, run: _Run, actions: np.ndarray | None) -> None:
        state: Literal["finished", "stopped", "failed"] = "finished"
        note = ""
        try:
            note = await self._play(run, actions)
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
        for side in run.sides.values():
            await side.end()

    async def _play(self, run: _Run, actions: np.ndarray | None) -> str:
        """Advance both sides to the end; returns why it ended early."""
        real, imagined, view = run.sides["real"], run.sides["imagined"], run.view
        # Each side puts the name of its world.
        request = schemas.StartRequest(
            world="", task=view.task, seed=view.seed, instruction=view.instruction
        )
        first = await real.start(request, None)
        imagined_first = await imagined.start(request, first)
        await self._add(run, first[0], imagined_first[0], None)
        size = _chunk_steps(run.sides)
        chunks = (
            _driven(run, HandDriver(*first, rate_hz=view.rate_hz), size)
            if actions is None
            else _replayed(actions[: view.num_steps], size)
        )
        number = 0
        async for rows in chunks:
            (truth, _), (guess, info) = await asyncio.gather(
                real.step(number, rows), imagined.step(number, rows)
            )
            await self._add(run, truth, guess, info.get(schemas.BOUND_SHARE))
            number += 1
        is_idle = actions is None and number * size < view.num_steps
        return f"Nobody moved the hands for {LEASE_S:.0f} s." if is_idle else ""

    async def _add(
        self,
        run: _Run,
        real: schemas.Observation,
        imagined: schemas.Observation,
        bound_share: float | None,
    ) -> None:
        """Add the steps of a chunk: their errors to the view, their images for the page."""
        added, message = await asyncio.to_thread(compared, real, imagined)
        run.messages.append(message)
        changes = {name: getattr(run.view, name) + values for name, values in added.items()}
        changes |= {"num_chunks": len(run.messages), "real_success": real.success}
        # The start is given, not imagined.
        if real.first_step:
            steps = {"first_step": real.first_step, "last_step": real.last_step}
            newest = ChunkUncertainty(
                **steps, uncertainty=imagined.uncertainty, bound_share=bound_share
            )
            changes["uncertainties"] = (*run.view.uncertainties, newest)
        run.view = run.view.model_copy(update=changes)


async def _replayed(actions: np.ndarray, size: int) -> AsyncIterator[np.ndarray]:
    for start in range(0, len(actions), size):
        yield actions[start : start + size]


async def _driven(run: _Run, driver: HandDriver, size: int) -> AsyncIterator[np.ndarray]:
    """Chunks as a person moves the hands, until nobody does for `LEASE_S`."""
    for _ in range(run.view.num_steps // size):
        try:
            async with asyncio.timeout(LEASE_S):
                moves, made = await run.moves.get()
        except TimeoutError:
            return
        yield driver.rows(moves, size)
        made.set()


def _worlds(sides: Mapping[str, Side]) -> list[schemas.WorldDescription]:
    return [one.world for one in sides.values() if isinstance(one, WorldSide)]


def _chunk_steps(sides: Mapping[str, Side]) -> int:
    """Steps at a time: as few as the worlds allow, so that uncertainty is seen when it rises."""
    return lcm(*(world.chunk_multiple for world in _worlds(sides)))


def compared(
    real: schemas.Observation, imagined: schemas.Observation
) -> tuple[dict[str, tuple[Any, ...]], bytes]:
    """Errors of every step, and the message with both worlds' images and touch.

    The message is laid out as that of `steps_message`, with the real world first in every array:
    touch [2, steps, 2, num_taxels] and images [2, steps, height, width, 3].
    """
    guessed = imagined.images[HEAD_CAMERA]
    images = [fitted(real.images[HEAD_CAMERA], guessed.shape[1:3]), guessed]
    touch = [seen.tactile_kpa for seen in (real, imagined)]
    difference = np.abs(images[0].astype(np.int16) - images[1])
    pairs = list(zip(*touch, strict=True))
    errors = {
        "pixel_error": tuple(difference.mean(axis=(1, 2, 3)).tolist()),
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


def _check_worlds(worlds: Sequence[schemas.WorldDescription], task: str) -> None:
    """Refuse worlds that cannot be compared step by step."""
    for one in worlds:
        if task not in one.tasks:
            raise InvalidInputError(
                f"world {one.name}: got task {task!r}, expected one of {', '.join(one.tasks)}"
            )
    shapes = [(one.image_height_px, one.image_width_px, one.model_rate_hz) for one in worlds]
    if len(set(shapes)) > 1:
        texts = [f"{height} by {width} px at {rate:g} Hz" for height, width, rate in shapes]
        raise InvalidInputError(
            f"worlds: got images of {' and of '.join(texts)}, expected the same; start the twin "
            "with the world model's image size"
        )
    gloves = {one.name: one.tactile_layout for one in worlds}
    others = {name: glove.name for name, glove in gloves.items() if glove is not None}
    if others:
        # The twin has no other glove to compare with.
        raise InvalidInputError(
            f"worlds: got the tactile layouts {others}, expected dextouch_v1 in both; only its "
            "taxels can be compared"
        )
