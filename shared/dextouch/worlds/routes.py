"""Routes of /v1/rollouts (docs/rollout_api.md), and a direct way to the route of chunks.

A chunk of a small world takes less time than FastAPI needs to find its route and to solve its
parameters. The shortcut answers requests whose query the route has already accepted once, with a
binary body; all others are left to the route, which stays the reference for both.
"""

import base64
import json
import re
import time
from typing import Annotated, Any, Final
from urllib.parse import unquote

import numpy as np
from fastapi import APIRouter, Depends, Path, Query, Request, Response
from jaxtyping import Shaped
from pydantic import Field, StrictFloat
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.frozen_model import FrozenModel, example
from dextouch.hands.actions import ACTION_DIM
from dextouch.schemas import (
    ForkRequest,
    JsonAnswer,
    ReturnSelector,
    RolloutInfo,
    RolloutStart,
    StartRequest,
    WatchedRollouts,
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
    AccessControl,
    RequireScope,
    decoded,
    header,
    media_type,
    takes,
    timed,
)
from dextouch.streams import unpack
from dextouch.worlds.records import ID_LETTERS, Answer, RolloutWatch
from dextouch.worlds.rollouts import RolloutService

MAX_BODY_BYTES = 2**28  # a start has images of all cameras
# Room for 1000 rows of float64, or some hundred rows as JSON.
MAX_CHUNK_BYTES = 2**20
# Of a chunk as JSON; more than any world takes at once.
MAX_ROWS = 4096

SCOPE: Final = "rollout"
WATCH_SCOPE: Final = "watch"
CLIENT_HEADER: Final = "dextouch-client"
MAX_CLIENT_LETTERS: Final = 64  # chosen: a name in a list
MAX_WATCHED: Final = 200  # chosen: a list that people read
REPLAYED_HEADER: Final = "dextouch-replayed"
DTYPES: Final[dict[str, np.dtype[Any]]] = {"float32": np.dtype("<f4"), "float64": np.dtype("<f8")}
_PATH: Final = re.compile(r"/v1/rollouts/([^/]+)/chunks/([0-9]{1,9})")
_DTYPE_OF: Final = {f"{OCTETS}; dtype={dtype}": dtype for dtype in DTYPES}
_REPLAYED, _COMPUTED = ((REPLAYED_HEADER.encode(), value) for value in (b"true", b"false"))
_CONTENT_TYPE: Final = (b"content-type", MSGPACK.encode())
_MAX_QUERIES: Final = 64  # chosen: clients use a few
_MAX_QUERY_BYTES: Final = 256  # chosen: cameras and options fit


class ActionsBody(FrozenModel):
    """A chunk as JSON: rows of 67 numbers, one for each step.

    Attributes:
        actions: poses of both wrists and the head camera relative to the start of the rollout, and
            joint angles of both hands (rad), in the order of docs/rollout_api.md.
    """

    model_config = example(actions=[[0.0] * ACTION_DIM] * 4)

    actions: Annotated[
        list[Annotated[list[StrictFloat], Field(fail_fast=True)]],
        Field(fail_fast=True, max_length=MAX_ROWS),
    ]


# Both routes that simulate answer with a packed observation, or as JSON if that is asked for.
ANSWER: dict[str, Any] = {
    "model": JsonAnswer,
    "content": {MSGPACK: {}},
    "headers": {
        REPLAYED_HEADER: {
            "description": "`true` if the answer is that of an earlier, equal request.",
            "schema": {"type": "string", "enum": ["true", "false"]},
        }
    },
}

# The dtype is a required parameter; float32 is taken, too.
BINARY_CHUNK: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            f"{OCTETS}; dtype=float64": {
                "schema": {
                    "type": "string",
                    "format": "binary",
                    "description": "[K, 67] in C order, little endian; also as `dtype=float32`.",
                }
            }
        },
    }
}

# From the query: ?steps=last&cameras=camera_head&tactile=false; unknown parameters are refused.
Selector = Annotated[ReturnSelector, Query()]
# The name of the caller's key.
Owner = Annotated[str, Depends(RequireScope(SCOPE))]
WatchId = Annotated[str, Path(pattern=f"^[0-9a-f]{{{ID_LETTERS}}}$")]


class ChunkShortcut:
    """Shortcut to the route of chunks of one rollout service (see `create_service_app`)."""

    def __init__(self, service: RolloutService) -> None:
        self._service = service
        # What the route made of a query.
        self._selectors: dict[bytes, tuple[ReturnSelector, Any]] = {}

    def learn(self, request: Request, selector: ReturnSelector) -> None:
        """Note what the route made of the query of a request."""
        query = request.scope["query_string"]
        if len(query) <= _MAX_QUERY_BYTES and len(self._selectors) < _MAX_QUERIES:
            self._selectors[query] = selector, request.scope["route"]

    def __call__(self, scope: Scope) -> ASGIApp | None:
        """The application that answers a request; None if its route is to do so."""
        learned = self._selectors.get(scope["query_string"])
        place = _PATH.fullmatch(scope["path"])
        if learned is None or place is None or scope["method"] != "POST":
            return None
        dtype = _DTYPE_OF.get(header(scope, b"content-type") or "")
        if dtype is None or wants_json(header(scope, b"accept") or ""):
            return None
        selector, scope["route"] = learned
        rollout_id, chunk = place[1], int(place[2])

        async def step(scope: Scope, receive: Receive, send: Send) -> None:
            access: AccessControl = scope["app"].state.access
            access.check(header(scope, b"authorization"), SCOPE)
            body = await _body(receive)
            spent_s: dict[str, float] = scope["state"]["timings_s"]
            began_s = time.perf_counter()
            try:
                actions = actions_from(body, dtype)
            finally:
                spent_s["decode"] = time.perf_counter() - began_s
            answer = await self._service.step(rollout_id, chunk, actions, selector)
            spent_s |= answer.spent_s
            answered = [
                _REPLAYED if answer.replayed else _COMPUTED,
                (b"content-length", b"%d" % len(answer.payload)),
                _CONTENT_TYPE,
            ]
            await send({"type": "http.response.start", "status": 200, "headers": answered})
            await send({"type": "http.response.body", "body": answer.payload})

        return step


def rollout_router(service: RolloutService, shortcut: ChunkShortcut) -> APIRouter:
    """Router of one rollout service; its route of chunks teaches the shortcut."""
    router = APIRouter(prefix="/v1", tags=["rollouts"], dependencies=[Depends(RequireScope(SCOPE))])

    @router.get("/worlds")
    async def list_worlds() -> WorldList:
        """List the worlds of this service: what they can start from, their cameras and tasks."""
        return WorldList(worlds=tuple(service.worlds()))

    @router.post(
        "/rollouts",
        status_code=201,
        response_class=Response,
        responses={201: ANSWER},
    )
    @takes({JSON: 16 * KIB, MSGPACK: AS_SET}, model=StartRequest)
    async def start_rollout(request: Request, selector: Selector, owner: Owner) -> Response:
        """Start a rollout from a task and seed, or from an observation in MessagePack.

        The answer holds the first observation, and the poses that actions are relative to. As JSON
        with `Accept: application/json`.
        """
        with timed(request, "decode"):
            chosen, begin = await _start_of(request)
        with timed(request, "world"):
            client = client_name(request.headers.get(CLIENT_HEADER, ""))
            answer = await service.start(chosen.world, begin, selector, owner=owner, client=client)
        return _response(request, answer, status=201)

    @router.get("/rollouts/{rollout_id}")
    async def get_rollout(rollout_id: str) -> RolloutInfo:
        """Get the progress of a rollout; does not renew its time to live."""
        return await service.get(rollout_id)

    @router.delete("/rollouts/{rollout_id}", status_code=204)
    async def delete_rollout(rollout_id: str) -> None:
        """End a rollout, and make room for another one."""
        await service.delete(rollout_id)

    @router.post(
        "/rollouts/{rollout_id}/chunks/{chunk}",
        response_class=Response,
        responses={200: ANSWER},
        openapi_extra=BINARY_CHUNK,
    )
    @takes({OCTETS: MAX_CHUNK_BYTES, JSON: MAX_CHUNK_BYTES}, model=ActionsBody)
    async def send_chunk(
        rollout_id: str, chunk: int, request: Request, selector: Selector
    ) -> Response:
        """Advance by the numbered action chunk, and return the observations of its steps.

        The newest chunk may be sent again, and gets the same answer. As JSON with
        `Accept: application/json`.
        """
        with timed(request, "decode"):
            actions = await _actions_of(request)
        answer = await service.step(rollout_id, chunk, actions, selector)
        request.state.timings_s |= answer.spent_s
        shortcut.learn(request, selector)
        return _response(request, answer)

    @router.post("/rollouts/{rollout_id}/fork", status_code=201)
    @takes({JSON: KIB})
    async def fork_rollout(rollout_id: str, request: ForkRequest, owner: Owner) -> RolloutInfo:
        """Branch at the current step: the copy shares the past and continues by itself."""
        return await service.fork(rollout_id, seed=request.seed, owner=owner)

    return router


def watch_router(watch: RolloutWatch) -> APIRouter:
    """Router of those who watch open rollouts and cannot change them."""
    may_watch = [Depends(RequireScope(WATCH_SCOPE))]
    router = APIRouter(prefix="/v1/watch", tags=["watching"], dependencies=may_watch)

    @router.get("")
    async def list_watched_rollouts(
        limit: Annotated[int, Query(ge=1, le=MAX_WATCHED)] = 100,
    ) -> WatchedRollouts:
        """List the open rollouts, the newest first."""
        return await watch.listed(limit)

    @router.get(
        "/{watch_id}", response_class=Response, responses={200: {"content": {MSGPACK: {}}}, 304: {}}
    )
    async def get_watched_response(request: Request, watch_id: WatchId) -> Response:
        """The newest response of a rollout, as its client asked for it."""
        known = request.headers.get("if-none-match", "").strip('"')
        tag, payload = await watch.newest(watch_id, known)
        headers = {"etag": f'"{tag}"', "cache-control": "no-store"}
        if payload is None:
            return Response(status_code=304, headers=headers)
        return Response(payload, headers=headers, media_type=MSGPACK)

    return router


def client_name(header: str) -> str:
    """What a client is called, of a percent-encoded header: printable, and not long."""
    name = "".join(letter for letter in unquote(header) if letter.isprintable())
    return name.strip()[:MAX_CLIENT_LETTERS]


async def _start_of(request: Request) -> tuple[StartRequest, RolloutStart]:
    kind, _ = media_type(request.headers.get("content-type"))
    body = await request.body()
    if kind == MSGPACK:
        # Encoding megabytes of images would block the event loop.
        return await run_in_threadpool(decode_start, body, max_bytes=MAX_BODY_BYTES)
    fields = validate_fields(StartRequest, body, where="body")
    return fields, start_from(fields)


async def _actions_of(request: Request) -> Shaped[np.ndarray, "..."]:
    kind, parameters = media_type(request.headers.get("content-type"))
    body = await request.body()
    if kind == JSON:
        return await decoded(_actions_from_json, body)
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
    encoded = {
        name: {
            "dtype": array.dtype.name,
            "shape": list(array.shape),
            "data": base64.b64encode(array.tobytes()).decode(),
        }
        for name, array in arrays.items()
    }
    return json.dumps({"fields": fields, "arrays": encoded}).encode()


async def _body(receive: Receive) -> bytes:
    parts, more = [], True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        parts.append(message.get("body", b""))
        more = message.get("more_body", False)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def wants_json(accepted: str) -> bool:
    """Whether a response is to be JSON rather than a packing."""
    return JSON in accepted and MSGPACK not in accepted


def actions_from(body: bytes, dtype: str) -> Shaped[np.ndarray, "..."]:
    """Actions [K, 67] of a binary body.

    Raises InvalidInputError for an unknown dtype, ShapeError for no whole rows.
    """
    if dtype not in DTYPES:
        raise InvalidInputError(
            f"chunk: got dtype {dtype!r}, expected the header "
            f"'Content-Type: {OCTETS}; dtype=float32' or float64"
        )
    row_bytes = ACTION_DIM * DTYPES[dtype].itemsize
    if not body or len(body) % row_bytes:
        raise ShapeError(
            f"chunk: got {len(body)} bytes, expected a multiple of {row_bytes} "
            f"([K, {ACTION_DIM}] {dtype}, little endian)"
        )
    return np.frombuffer(body, DTYPES[dtype]).reshape(-1, ACTION_DIM)
