"""Direct way to the route of chunks for the form in which our clients send them.

A chunk of a small world takes less time than FastAPI needs to find its route and to solve its
parameters. The shortcut answers requests whose query the route has already accepted once, with a
binary body; all others are left to the route, which stays the reference for both.
"""

import re
import time
from typing import Any, Final

import numpy as np
from fastapi import Request
from jaxtyping import Shaped
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands.actions import ACTION_DIM
from dextouch.schemas import ReturnSelector
from dextouch.serving import JSON, MSGPACK, OCTETS, AccessControl
from dextouch.worlds.rollouts import RolloutService

SCOPE: Final = "rollout"
REPLAYED_HEADER: Final = "dextouch-replayed"
DTYPES: Final = ("float32", "float64")
_PATH: Final = re.compile(r"/v1/rollouts/([^/]+)/chunks/([0-9]{1,9})")
_DTYPE_OF: Final = {f"{OCTETS}; dtype={dtype}".encode(): dtype for dtype in DTYPES}
_MAX_QUERIES: Final = 64
_MAX_QUERY_BYTES: Final = 256


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
        # Of several headers of one name the first counts, as in Starlette.
        headers = dict(scope["headers"][::-1])
        dtype = _DTYPE_OF.get(headers.get(b"content-type", b""))
        if dtype is None or wants_json(headers.get(b"accept", b"").decode("latin-1")):
            return None
        selector, scope["route"] = learned
        rollout_id, chunk = place[1], int(place[2])

        async def step(scope: Scope, receive: Receive, send: Send) -> None:
            access: AccessControl = scope["app"].state.access
            access.check(headers.get(b"authorization", b"").decode("latin-1"), SCOPE)
            body = await _body(receive)
            spent_s: dict[str, float] = scope["state"]["timings_s"]
            began_s = time.perf_counter()
            try:
                actions = actions_from(body, dtype)
            finally:
                spent_s["decode"] = time.perf_counter() - began_s
            answer = await self._service.step(rollout_id, chunk, actions, selector)
            spent_s |= answer.spent_s
            size = str(len(answer.payload)).encode()
            replayed = b"true" if answer.replayed else b"false"
            shown = [
                (REPLAYED_HEADER.encode(), replayed),
                (b"content-length", size),
                (b"content-type", MSGPACK.encode()),
            ]
            await send({"type": "http.response.start", "status": 200, "headers": shown})
            await send({"type": "http.response.body", "body": answer.payload})

        return step


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

    Raises:
        InvalidInputError: an unknown dtype.
        ShapeError: no whole rows.
    """
    if dtype not in DTYPES:
        raise InvalidInputError(
            f"chunk: got dtype {dtype!r}, expected the header "
            f"'Content-Type: {OCTETS}; dtype=float32' or float64"
        )
    row_bytes = ACTION_DIM * np.dtype(dtype).itemsize
    if not body or len(body) % row_bytes:
        raise ShapeError(
            f"chunk: got {len(body)} bytes, expected a multiple of {row_bytes} "
            f"([K, {ACTION_DIM}] {dtype}, little endian)"
        )
    return np.frombuffer(body, np.dtype(dtype).newbyteorder("<")).reshape(-1, ACTION_DIM)
