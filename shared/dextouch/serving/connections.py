"""Connections and requests of a service: limits and deadlines, request ids, timings, shortcuts.

uvicorn by itself waits for ever for a request that has begun, and for clients that do not read.
Every response has a request id and a Server-Timing header; `timed` adds parts to the latter.
"""

import asyncio
import os
import re
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from http import HTTPStatus
from typing import Any

import structlog
from httptools import HttpParserError
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Metric
from prometheus_client.registry import Collector
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from dextouch.errors import DexTouchError, InvalidInputError, UnavailableError
from dextouch.schemas import PROBLEM_MEDIA_TYPE, problem_from_error
from dextouch.serving.guard import Refuse, header
from dextouch.serving.logs import masked
from dextouch.serving.refusals import RefusalLog, caller_of
from dextouch.serving.spans import traced

logger = structlog.get_logger(__name__)

# Clients that are at least as fast never run out of time.
MIN_BYTES_PER_S = 16 * 2**10
# Of a request, beside its body.
MAX_HEADER_BYTES = 2**16
# Bytes of a header's line beside its name and value: ": " and the end of the line.
NUM_SEPARATORS = 4
# Of unfinished messages of all WebSockets of a process together, beside those of 64 KiB: 16 of the
# largest that a policy may send (`MAX_BODY_BYTES`), each of which takes well below a second.
MAX_UNFINISHED_BYTES = 2**28
# Larger ones count there.
ORDINARY_MESSAGE_BYTES = 2**16
# Clients that are told at the same time that there is no place; further ones are just closed.
MAX_REFUSED = 64
MAX_CHECK_PERIOD_S = 1.0
REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
OWN_HEADERS = frozenset({b"x-request-id", b"server-timing"})
KNOWN_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)

# Of a WebSocket's scope: sets the largest message that its client may send.
MESSAGE_LIMIT = "dextouch.message_limit"

# Finds the ASGI application that answers a request in place of its route, which takes some 0.4 ms
# of FastAPI's time; None leaves the request to the route. It checks the scope of the key itself,
# sets `scope["route"]`, raises DexTouch errors like a route, and sends nothing before it succeeds.
Shortcut = Callable[[Scope], ASGIApp | None]
# Method, route, status, seconds, and parts of them by name.
_Answered = tuple[str, str, int, float, tuple[tuple[str, float], ...]]
# Some hundred bytes each.
MAX_UNCOUNTED = 1024


def limited_protocols(*, max_connections: int, client_timeout_s: float) -> dict[str, Any]:
    """Options of uvicorn for a limited number of connections with clients that are not too slow.

    A connection without a request makes room for a new one, the oldest first; if there is none, new
    ones get status 503. A client may take `client_timeout_s` in all to send a request, or a message
    of a WebSocket, and to read the response; only time at less than 16 KiB/s counts.
    """
    limits = _Limits(max_connections, client_timeout_s)
    return {
        "http": partial(_LimitedHttp, limits=limits),
        "ws": partial(_LimitedWebSocket, limits=limits),
    }


@dataclass(frozen=True)
class _Limits:
    """Limits of one server, and its connections without a request, the oldest first."""

    max_connections: int
    client_timeout_s: float
    idle: dict["_LimitedHttp", None] = field(default_factory=dict)
    # Bytes of large unfinished messages, the first begun first.
    unfinished: dict["_LimitedWebSocket", int] = field(default_factory=dict)

    # Made in the process that needs it: with several workers the limits are sent to each.
    @cached_property
    def refusals(self) -> RefusalLog:
        return RefusalLog()

    @property
    def check_period_s(self) -> float:
        return min(self.client_timeout_s / 8, MAX_CHECK_PERIOD_S)


class _Watched(asyncio.Protocol):
    """Ends a connection whose client keeps the service waiting for too long in all.

    Time counts only while the service waits for the client, and each 16 KiB give a second back.
    """

    loop: asyncio.AbstractEventLoop
    transport: asyncio.Transport
    connections: set[Any]

    def __init__(self, *, limits: _Limits, **given: Any) -> None:  # noqa: ANN401 - uvicorn's
        super().__init__(**given)
        self._limits = limits
        self._left_s = limits.client_timeout_s
        self._moved_bytes = 0
        self._unsent_bytes = 0

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401 - of asyncio or uvloop
        super().connection_made(transport)
        self._check_later()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._left_s = self._limits.client_timeout_s

    def _waits_for_request(self) -> bool:
        return False

    def _time_out(self) -> None:
        self.transport.abort()

    def _check_later(self) -> None:
        self.loop.call_later(self._limits.check_period_s, self._check)

    def _check(self) -> None:
        # A lost connection, or one that has become a WebSocket.
        if self not in self.connections:
            return
        unsent = self.transport.get_write_buffer_size()
        if unsent or self._waits_for_request():
            moved = self._moved_bytes + max(0, self._unsent_bytes - unsent)
            left_s = self._left_s - self._limits.check_period_s + moved / MIN_BYTES_PER_S
            self._left_s = min(left_s, self._limits.client_timeout_s)
        else:
            self._left_s = self._limits.client_timeout_s
        self._moved_bytes, self._unsent_bytes = 0, unsent
        if self._left_s <= 0:
            logger.info("client_too_slow", client=self.transport.get_extra_info("peername"))
            self._time_out()
        self._check_later()


class _LimitedWebSocket(_Watched, WebSocketsSansIOProtocol):
    """WebSocket whose client must read, and end each message that it begins.

    Where unfinished messages need too much memory together, the one begun first ends with its
    connection (close code 1013, try again later). uvicorn's pings find clients that are gone.
    """

    def __init__(self, *, limits: _Limits, **given: Any) -> None:  # noqa: ANN401 - uvicorn's
        super().__init__(limits=limits, **given)
        # Frames of a message that has not ended, joined: each by itself may be a single byte.
        self._begun = bytearray()
        self._unfinished_bytes = 0

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        buffered = len(self.conn.reader.buffer)
        unfinished = buffered + len(self._begun) + sum(map(len, self.frames))
        if unfinished == self._unfinished_bytes:
            return
        # Only what is of a message counts: pings could be sent for ever.
        if not self.transport.get_write_buffer_size():
            self._moved_bytes += max(0, unfinished - self._unfinished_bytes)
        self._unfinished_bytes = unfinished
        self._limit_memory()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._limits.unfinished.pop(self, None)

    def _limit_memory(self) -> None:
        all_unfinished = self._limits.unfinished
        if self._unfinished_bytes <= ORDINARY_MESSAGE_BYTES:
            all_unfinished.pop(self, None)
            return
        all_unfinished[self] = self._unfinished_bytes
        while sum(all_unfinished.values()) > MAX_UNFINISHED_BYTES:
            first = next(iter(all_unfinished))
            del all_unfinished[first]
            first.close_for_memory()

    def close_for_memory(self) -> None:
        """End the connection and the message that it has begun."""
        logger.warning("websocket_closed", reason="memory", num_bytes=self._unfinished_bytes)
        self._begun, self.frames = bytearray(), []
        if not self.close_sent:
            reason = "unfinished messages of all clients need too much memory; try again later"
            self.queue.put_nowait({"type": "websocket.disconnect", "code": 1013, "reason": reason})
            self.conn.send_close(1013, reason)
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.close_sent = True
        self.transport.close()

    def handle_cont(self, event: Any) -> None:  # noqa: ANN401 - of websockets
        self._begun += b"".join([*self.frames, event.data])
        self.frames = []
        if event.fin:
            self.frames = [bytes(self._begun)]
            self._begun.clear()
            self.send_receive_event_to_app()

    def send_receive_event_to_app(self) -> None:
        super().send_receive_event_to_app()
        if not self.transport.get_write_buffer_size():
            self._left_s = self._limits.client_timeout_s

    def _waits_for_request(self) -> bool:
        return self._unfinished_bytes > 0 and not self.read_paused

    def handle_connect(self, event: Any) -> None:  # noqa: ANN401 - of websockets
        super().handle_connect(event)
        # The application begins later; a handshake that was refused has none, and no scope.
        if not self.handshake_complete:
            extensions: dict[str, Any] = self.scope.setdefault("extensions", {})
            extensions[MESSAGE_LIMIT] = self._accept_messages_of

    def _accept_messages_of(self, num_bytes: int) -> None:
        self.conn.max_message_size = num_bytes


def accept_messages_of(socket: WebSocket, num_bytes: int) -> None:
    """Let the client of a WebSocket send messages of `num_bytes`, once its key is known.

    Others may send 64 KiB (`MAX_WEBSOCKET_BYTES`); another server than ours keeps its own limit.
    """
    limit = socket.scope.get("extensions", {}).get(MESSAGE_LIMIT)
    if limit is not None:
        limit(num_bytes)


class _LimitedHttp(_Watched, HttpToolsProtocol):
    """HTTP connection with a time limit for requests, and a place among a limited number."""

    def __init__(self, *, limits: _Limits, **given: Any) -> None:  # noqa: ANN401 - uvicorn's
        super().__init__(limits=limits, **given)
        self._is_receiving = True
        self._has_begun = False
        self._is_refused = False
        self._received_bytes = self._header_bytes = 0

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401 - of asyncio or uvloop
        super().connection_made(transport)
        idle, limit = self._limits.idle, self._limits.max_connections
        num_open = len(self.connections)
        if num_open > limit:
            oldest = next(iter(idle), None)
            if oldest is not None:
                del idle[oldest]
                oldest.transport.close()
            elif num_open > limit + MAX_REFUSED:
                self.transport.abort()
                return
            else:
                text = f"the service has {limit} connections, expected fewer; try again later"
                self._refuse(503, UnavailableError(text, retry_after_s=1))
                return
        idle[self] = None

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._limits.idle.pop(self, None)

    def data_received(self, data: bytes) -> None:
        if self._is_refused:
            return
        if self.timeout_keep_alive_task is not None:
            # Even if it is no request, such as an empty line.
            self._is_receiving, self._has_begun, self._received_bytes = True, False, 0
        self._received_bytes += len(data)
        self._moved_bytes += len(data)
        super().data_received(data)
        # The parser keeps a header to itself until its end.
        too_many = self._received_bytes > MAX_HEADER_BYTES
        if too_many and self._is_receiving and not self._is_refused:
            with suppress(HttpParserError):
                self._refuse_headers(self._received_bytes)

    def _refuse_headers(self, num_bytes: int) -> None:
        """Refuse a request with too many bytes beside its body; the error ends its parsing."""
        text = f"got {num_bytes} bytes of headers, expected at most {MAX_HEADER_BYTES}"
        self._refuse(431, InvalidInputError(text))
        raise HttpParserError(text)

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._is_receiving, self._has_begun = True, True
        self._received_bytes = self._header_bytes = 0

    def on_url(self, url: bytes) -> None:
        self._header_bytes += len(url)
        if self._header_bytes > MAX_HEADER_BYTES:
            self._refuse_headers(self._header_bytes)
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        self._header_bytes += len(name) + len(value) + NUM_SEPARATORS
        if self._header_bytes > MAX_HEADER_BYTES:
            self._refuse_headers(self._header_bytes)
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._limits.idle.pop(self, None)
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        super().on_body(body)
        # The bytes around the pieces of a body may be as many as the body.
        self._received_bytes = max(0, self._received_bytes - 2 * len(body))

    def on_message_complete(self) -> None:
        super().on_message_complete()
        self._is_receiving = False

    def send_400_response(self, msg: str) -> None:
        # Also called where `_refuse_headers` has answered.
        if self._is_refused:
            return
        self._note_refusal(400, "no valid HTTP")
        super().send_400_response(msg)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.timeout_keep_alive_task is not None:
            self._limits.idle[self] = None

    def _has_headers(self) -> bool:
        return self.cycle is not None and self.cycle.scope is self.scope

    def _waits_for_request(self) -> bool:
        if self._has_headers() and self.cycle.response_complete:
            # The rest of a request that was refused.
            self._moved_bytes = 0
        return self._is_receiving and not self.flow.read_paused

    def _time_out(self) -> None:
        is_answered = self._has_headers() and self.cycle.response_started
        if self._is_refused or is_answered or not self._is_receiving or not self._has_begun:
            self.transport.abort()
            return
        limit_s = self._limits.client_timeout_s
        text = f"got a part, expected the request within {limit_s:g} s or at 16 KiB/s"
        self._refuse(408, UnavailableError(text))

    def _refuse(self, status: int, error: DexTouchError) -> None:
        """Answer and end the connection.

        It is read for a moment more: closing at once could make the client lose the answer.
        """
        is_working = self.cycle is not None and not self.cycle.response_complete
        if self.pipeline or (is_working and not self._has_headers()):
            # The client would take this for the answer to its earlier request.
            self._is_refused = True
            self.transport.abort()
            return
        if is_working:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self._limits.idle.pop(self, None)
        self._note_refusal(status, error.message)
        self._is_refused = self._is_receiving = True
        self._left_s = 1.5 * self._limits.check_period_s
        self.transport.write(_answer(status, error))
        self.transport.write_eof()

    def _note_refusal(self, status: int, reason: str) -> None:
        self._limits.refusals.note_caller(caller_of({"client": self.client}), status, reason)


def _answer(status: int, error: DexTouchError) -> bytes:
    problem = problem_from_error(error, instance="", request_id="")
    body = problem.model_copy(update={"status": status}).model_dump_json().encode()
    headers: Mapping[str, object] = {
        "content-type": PROBLEM_MEDIA_TYPE,
        "content-length": len(body),
        "connection": "close",
        **({"retry-after": 1} if status == HTTPStatus.SERVICE_UNAVAILABLE else {}),
    }
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    return f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\n{lines}\r\n".encode() + body


@dataclass(frozen=True)
class ShortcutMiddleware:
    """ASGI middleware that lets a shortcut answer the requests that it knows.

    `refuse` makes the response to a refused request.
    """

    app: ASGIApp
    refuse: Refuse

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; other scopes pass through."""
        shortcut: Shortcut | None = scope["app"].state.shortcut
        direct = shortcut(scope) if shortcut is not None and scope["type"] == "http" else None
        if direct is None:
            await self.app(scope, receive, send)
            return
        try:
            await direct(scope, receive, send)
        except (DexTouchError, HTTPException) as error:
            await self.refuse(Request(scope), error)(scope, receive, send)


class _Uncounted(Collector):
    """Requests that have been answered and are counted when metrics are read.

    Counting takes a tenth of the time of a small chunk. Registered before the metrics themselves.
    """

    def __init__(self, count: Callable[[_Answered], None]) -> None:
        self._count = count
        self._waiting: list[_Answered] = []

    def add(self, answered: _Answered) -> None:
        """Note one; many are counted at once now and then, to bound the memory."""
        self._waiting.append(answered)
        if len(self._waiting) >= MAX_UNCOUNTED:
            self.collect()

    def collect(self) -> Iterable[Metric]:
        waiting, self._waiting = self._waiting, []
        for answered in waiting:
            self._count(answered)
        return ()


class RequestMiddleware:
    """Sets `request.state.request_id` and `.timings_s`, the headers for them, and counts requests.

    The counters belong to the given Prometheus registry.
    """

    def __init__(self, app: ASGIApp, *, registry: CollectorRegistry) -> None:
        self._app = app
        self._uncounted = _Uncounted(self._count)
        registry.register(self._uncounted)
        self._requests = Counter(
            "dextouch_http_requests",
            "Answered requests.",
            ("method", "route", "status"),
            registry=registry,
        )
        self._seconds = Histogram(
            "dextouch_http_request_seconds",
            "Time from the first byte to the answer's head.",
            ("method", "route"),
            buckets=SECONDS,
            registry=registry,
        )
        self._parts_seconds = Histogram(
            "dextouch_http_part_seconds",
            "Parts of the time to an answer, as in its Server-Timing header.",
            ("route", "part"),
            buckets=SECONDS,
            registry=registry,
        )
        self._websockets = Gauge(
            "dextouch_websockets", "Open WebSockets.", ("route",), registry=registry
        )
        self._counter = cache(self._requests.labels)
        self._part_histogram = cache(self._parts_seconds.labels)
        self._histogram = cache(self._seconds.labels)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; other scopes pass through."""
        if scope["type"] == "websocket":
            await self._count_websocket(scope, receive, send)
            return
        if scope["type"] != "http":
            await self._app(scope, receive, partial(_send_without_trace, scope, send))
            return
        started = time.perf_counter()
        given = header(scope, b"x-request-id") or ""
        is_usable = given and REQUEST_ID.fullmatch(given) and masked(given) == given
        request_id = given if is_usable else os.urandom(16).hex()
        timings_s: dict[str, float] = {}
        scope.setdefault("state", {}).update(request_id=request_id, timings_s=timings_s)

        def send_with_headers(message: Message) -> Awaitable[None]:
            if message["type"] == "http.response.start":
                duration_s = time.perf_counter() - started
                timings = [f"{part};dur={spent_s * 1e3:.2f}" for part, spent_s in timings_s.items()]
                timings.append(f"total;dur={duration_s * 1e3:.2f}")
                headers = [one for one in message.get("headers", ()) if one[0] not in OWN_HEADERS]
                message["headers"] = [
                    *headers,
                    (b"x-request-id", request_id.encode()),
                    (b"server-timing", ", ".join(timings).encode()),
                ]
                scope["state"]["status"] = message["status"]
                # The route template, not the path, to keep the number of labels bounded.
                route = getattr(scope.get("route"), "path", "unmatched")
                parts_s = tuple(timings_s.items())
                self._uncounted.add(
                    (scope["method"], route, message["status"], duration_s, parts_s)
                )
            return send(message)

        with traced(scope) as span:
            scope["state"]["trace_id"] = span.trace_id
            tokens = structlog.contextvars.bind_contextvars(
                request_id=request_id, trace_id=span.trace_id
            )
            try:
                await self._app(scope, receive, send_with_headers)
            finally:
                structlog.contextvars.reset_contextvars(**tokens)

    async def _count_websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        opened: list[Gauge] = []

        def send_and_count(message: Message) -> Awaitable[None]:
            if message["type"] == "websocket.accept":
                opened.append(self._websockets.labels(scope["route"].path))
                opened[0].inc()
            return send(message)

        try:
            await self._app(scope, receive, send_and_count)
        finally:
            for gauge in opened:
                gauge.dec()

    def _count(self, answered: _Answered) -> None:
        sent_method, route, status, duration_s, parts_s = answered
        method = sent_method if sent_method in KNOWN_METHODS else "OTHER"
        self._counter(method, route, str(status)).inc()
        self._histogram(method, route).observe(duration_s)
        for part, spent_s in parts_s:
            self._part_histogram(route, part).observe(spent_s)


async def _send_without_trace(scope: Scope, send: Send, message: Message) -> None:
    """Send a message of the lifespan; its owner reports a refusal to start, in one line."""
    if message["type"] == "lifespan.startup.failed" and scope["app"].state.start_error is not None:
        message = {**message, "message": ""}
    await send(message)


@contextmanager
def timed(request: Request, part: str) -> Iterator[None]:
    """Time a part of a request (`queue`, `device`, `encode`, …) for its Server-Timing header."""
    started = time.perf_counter()
    try:
        yield
    finally:
        timings_s: dict[str, float] = request.state.timings_s
        timings_s[part] = timings_s.get(part, 0.0) + time.perf_counter() - started
