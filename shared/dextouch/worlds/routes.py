"""Application that serves worlds over HTTP: the routes of /v1/rollouts (docs/rollout_api.md)."""

import base64
import json
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, FastAPI, Query, Request, Response
from jaxtyping import Shaped
from pydantic import Field, model_validator
from starlette.concurrency import run_in_threadpool

from dextouch.errors import ShapeError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.actions import ACTION_DIM
from dextouch.schemas import (
    ForkRequest,
    ReturnSelector,
    RolloutInfo,
    RolloutStart,
    StartRequest,
    WorldList,
    decode_start,
    start_from,
    validate_fields,
)
from dextouch.serving import (
    AS_SET,
    JSON,
    KIB,
    MSGPACK,
    OCTETS,
    RequireScope,
    ServiceSettings,
    configure_logging,
    create_service_app,
    media_type,
    open_state,
    run,
    run_workers,
    server_options,
    takes,
    timed,
)
from dextouch.streams import unpack
from dextouch.worlds.answers import Answer
from dextouch.worlds.chunk_shortcut import (
    REPLAYED_HEADER,
    SCOPE,
    ChunkShortcut,
    actions_from,
    wants_json,
)
from dextouch.worlds.openpi import openpi_router
from dextouch.worlds.rollouts import Reopen, RolloutLimits, RolloutService
from dextouch.worlds.world import World

MAX_BODY_BYTES = 2**28
# Room for 1000 rows of float64, or some hundred rows as JSON.
MAX_CHUNK_BYTES = 2**20
# Of a chunk as JSON; more than any world takes at once.
MAX_ROWS = 4096
# Bodies above it are decoded in a thread, so that others need not wait.
MAX_INLINE_BYTES = 64 * KIB


class ActionsBody(FrozenModel):
    """A chunk as JSON: rows of 67 numbers."""

    actions: Annotated[
        list[Annotated[list[float], Field(fail_fast=True)]],
        Field(fail_fast=True, max_length=MAX_ROWS),
    ]


# Both routes that simulate answer with a packed observation, or as JSON if that is asked for.
ANSWER: dict[str, Any] = {"content": {MSGPACK: {}, JSON: {}}}

# From the query: ?steps=last&cameras=camera_head&tactile=false; unknown parameters are refused.
Selector = Annotated[ReturnSelector, Query()]
# The name of the caller's key.
Owner = Annotated[str, Depends(RequireScope(SCOPE))]


class WorldServiceSettings(ServiceSettings):
    """Settings of a service of worlds; subclass to add those of a world."""

    state_url: str = Field(
        default="memory://",
        description="store of rollouts: memory:// or redis://HOST:PORT/DB",
    )
    limits: RolloutLimits = RolloutLimits()
    workers: int = Field(
        default=1, ge=1, le=64, description="processes on one port; more than one needs redis://"
    )
    drain_s: float = Field(
        default=0.0,
        ge=0,
        le=600,
        description="seconds after SIGTERM without new rollouts and not ready, before the port is "
        "closed (of one process)",
    )

    @model_validator(mode="after")
    def _workers_share_their_state(self) -> "WorldServiceSettings":
        if self.workers > 1 and self.state_url == "memory://":
            raise ValueError(
                f"workers: got {self.workers} with state_url memory://, which each of them would "
                "have for itself; set state_url to redis://HOST:PORT/DB"
            )
        return self


def create_world_app(
    worlds: Mapping[str, World[Any]],
    settings: WorldServiceSettings,
    *,
    name: str = "worlds",
    reopen: Reopen | None = None,
    warm_up: bool = False,
) -> FastAPI:
    """Create the application; its shutdown ends the worlds' threads.

    Args:
        worlds: by name.
        settings: of the service.
        name: of the service.
        reopen: opens a world by name and digest, for rollouts that began in an earlier one.
        warm_up: compute a first chunk of each world before the application is ready.

    Returns:
        The application; `app.state.drain()` refuses new rollouts and makes it not ready.
    """
    store = open_state(settings.state_url)
    service = RolloutService(worlds, store, settings.limits, reopen=reopen)
    shortcut = ChunkShortcut(service)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        if warm_up:
            await service.warm_up()
        yield
        service.close()
        await store.close()

    async def readiness() -> list[str]:
        await store.ping()
        return ["shutdown"] if service.is_draining else []

    app = create_service_app(
        name=name,
        settings=settings,
        routers=[rollout_router(service, shortcut), openpi_router(service)],
        lifespan=lifespan,
        readiness=readiness,
    )
    app.state.shortcut = shortcut
    app.state.drain = service.drain
    app.state.registry.register(service.batches)
    return app


def serve_worlds(
    open_worlds: Callable[[], Mapping[str, World[Any]]],
    settings: WorldServiceSettings,
    *,
    name: str = "worlds",
    reopen: Reopen | None = None,
) -> None:
    """Serve worlds until SIGINT or SIGTERM, with as many processes as the settings say.

    Args:
        open_worlds: picklable; called in each process.
        settings: of the service.
        name: of the service.
        reopen: see create_world_app; picklable, too.
    """
    configure_logging(service=name, log_format=settings.log_format, level=settings.log_level)
    create_app = partial(create_serving_app, open_worlds, settings, name, reopen)
    if settings.workers == 1:
        app = create_app()
        run(app, settings, drain=app.state.drain, drain_s=settings.drain_s)
        return
    run_workers(
        create_app,
        host=settings.host,
        port=settings.port,
        num_workers=settings.workers,
        options=server_options(settings, grace_s=settings.shutdown_grace_s),
    )


def create_serving_app(
    open_worlds: Callable[[], Mapping[str, World[Any]]],
    settings: WorldServiceSettings,
    name: str,
    reopen: Reopen | None = None,
) -> FastAPI:
    """The application of one of several processes, which computes a first chunk in each world."""
    configure_logging(service=name, log_format=settings.log_format, level=settings.log_level)
    return create_world_app(open_worlds(), settings, name=name, reopen=reopen, warm_up=True)


def rollout_router(service: RolloutService, shortcut: ChunkShortcut) -> APIRouter:
    """Router of one rollout service; its route of chunks teaches the shortcut."""
    router = APIRouter(prefix="/v1", tags=["rollouts"], dependencies=[Depends(RequireScope(SCOPE))])

    @router.get("/worlds")
    async def worlds() -> WorldList:
        """List the available worlds."""
        return WorldList(worlds=tuple(service.worlds()))

    @router.post(
        "/rollouts",
        status_code=201,
        response_class=Response,
        responses={201: ANSWER},
        openapi_extra=_json_body(StartRequest),
    )
    @takes({JSON: 16 * KIB, MSGPACK: AS_SET})
    async def start(request: Request, selector: Selector, owner: Owner) -> Response:
        """Start a rollout from a task and seed, or from an observation."""
        with timed(request, "decode"):
            asked, begin = await _start_of(request)
        with timed(request, "world"):
            answer = await service.start(asked.world, begin, selector, owner=owner)
        return _response(request, answer, status=201)

    @router.get("/rollouts/{rollout_id}")
    async def get(rollout_id: str) -> RolloutInfo:
        """Get the state of a rollout."""
        return await service.get(rollout_id)

    @router.delete("/rollouts/{rollout_id}", status_code=204)
    async def delete(rollout_id: str) -> None:
        """End a rollout."""
        await service.delete(rollout_id)

    @router.post(
        "/rollouts/{rollout_id}/chunks/{chunk}",
        response_class=Response,
        responses={200: ANSWER},
        openapi_extra=_json_body(ActionsBody),
    )
    @takes({OCTETS: MAX_CHUNK_BYTES, JSON: MAX_CHUNK_BYTES})
    async def step(rollout_id: str, chunk: int, request: Request, selector: Selector) -> Response:
        """Advance by the numbered action chunk."""
        with timed(request, "decode"):
            actions = await _actions_of(request)
        answer = await service.step(rollout_id, chunk, actions, selector)
        request.state.timings_s |= answer.spent_s
        shortcut.learn(request, selector)
        return _response(request, answer)

    @router.post("/rollouts/{rollout_id}/fork", status_code=201)
    @takes({JSON: KIB})
    async def fork(rollout_id: str, asked: ForkRequest, owner: Owner) -> RolloutInfo:
        """Branch at the current step."""
        return await service.fork(rollout_id, seed=asked.seed, owner=owner)

    return router


def _json_body(model: type[FrozenModel]) -> dict[str, Any]:
    """OpenAPI fields of a body that the route reads by itself."""
    content = {JSON: {"schema": model.model_json_schema()}}
    return {"requestBody": {"required": True, "content": content}}


async def _start_of(request: Request) -> tuple[StartRequest, RolloutStart]:
    kind, _ = media_type(request.headers.get("content-type"))
    body = await request.body()
    if kind == MSGPACK:
        # Encoding megabytes of images would block the event loop.
        return await run_in_threadpool(decode_start, body, max_bytes=MAX_BODY_BYTES)
    asked = validate_fields(StartRequest, body, where="body")
    return asked, start_from(asked)


async def _actions_of(request: Request) -> Shaped[np.ndarray, "..."]:
    kind, parameters = media_type(request.headers.get("content-type"))
    body = await request.body()
    if kind == JSON:
        if len(body) > MAX_INLINE_BYTES:
            return await run_in_threadpool(_actions_from_json, body)
        return _actions_from_json(body)
    return actions_from(body, parameters.get("dtype", ""))


def _actions_from_json(body: bytes) -> Shaped[np.ndarray, "..."]:
    rows = validate_fields(ActionsBody, body, where="body").actions
    if any(len(row) != ACTION_DIM for row in rows) or not rows:
        lengths = sorted({len(row) for row in rows})
        raise ShapeError(f"chunk: got rows of {lengths} numbers, expected {ACTION_DIM}")
    return np.array(rows, dtype=np.float64)


def _response(request: Request, answer: Answer, *, status: int = 200) -> Response:
    headers = {REPLAYED_HEADER: "true" if answer.replayed else "false"}
    if wants_json(request.headers.get("accept", "")):
        with timed(request, "encode"):
            content, media_type = _as_json(answer.payload), JSON
        return Response(content, status, headers, media_type)
    return Response(answer.payload, status, headers, MSGPACK)


def _as_json(payload: bytes) -> bytes:
    """A response as JSON: the packing's layout with array data in base64."""
    fields, arrays = unpack(payload, max_bytes=len(payload))
    shown = {
        name: {
            "dtype": array.dtype.name,
            "shape": list(array.shape),
            "data": base64.b64encode(array.tobytes()).decode(),
        }
        for name, array in arrays.items()
    }
    return json.dumps({"fields": fields, "arrays": shown}).encode()
