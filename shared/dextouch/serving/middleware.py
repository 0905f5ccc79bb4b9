"""Request middleware: request ids, Server-Timing and Prometheus counters."""

import re
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager

import structlog
from fastapi import Request
from prometheus_client import CollectorRegistry, Counter, Histogram
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


class RequestMetrics:
    """Prometheus metrics of one service, in its own registry."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.requests = Counter(
            "dextouch_http_requests",
            "Answered requests.",
            ("method", "route", "status"),
            registry=registry,
        )
        self.seconds = Histogram(
            "dextouch_http_request_seconds",
            "Time from the first byte to the answer's head.",
            ("method", "route"),
            buckets=SECONDS,
            registry=registry,
        )


class RequestMiddleware:
    """Sets `request.state.request_id` and `.timings_s`, and the response headers for them."""

    def __init__(self, app: ASGIApp, *, metrics: RequestMetrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; other scopes (lifespan, websocket) pass through."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()
        headers = Headers(scope=scope)
        state = scope.setdefault("state", {})
        state["request_id"] = _request_id(headers)
        state["timings_s"] = {}

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                duration_s = time.perf_counter() - started
                answer = MutableHeaders(scope=message)
                answer["x-request-id"] = state["request_id"]
                answer["server-timing"] = _server_timing(state["timings_s"], duration_s)
                self._count(scope, message["status"], duration_s)
            await send(message)

        with structlog.contextvars.bound_contextvars(request_id=state["request_id"]):
            await self._app(scope, receive, send_with_headers)

    def _count(self, scope: Scope, status: int, duration_s: float) -> None:
        # The route template, not the path, to keep the number of labels bounded.
        route = getattr(scope.get("route"), "path", "unmatched")
        method = scope["method"] if scope["method"] in KNOWN_METHODS else "OTHER"
        self._metrics.requests.labels(method, route, str(status)).inc()
        self._metrics.seconds.labels(method, route).observe(duration_s)


KNOWN_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


@contextmanager
def timed(request: Request, part: str) -> Iterator[None]:
    """Time a part of a request (`queue`, `device`, `encode`, …) for its Server-Timing header."""
    started = time.perf_counter()
    try:
        yield
    finally:
        timings_s: dict[str, float] = request.state.timings_s
        timings_s[part] = timings_s.get(part, 0.0) + time.perf_counter() - started


def _request_id(headers: Headers) -> str:
    given = headers.get("x-request-id", "")
    return given if REQUEST_ID.fullmatch(given) else uuid.uuid4().hex


def _server_timing(timings_s: dict[str, float], total_s: float) -> str:
    parts = [*timings_s.items(), ("total", total_s)]
    return ", ".join(f"{name};dur={seconds * 1e3:.2f}" for name, seconds in parts)
