"""Factory of service applications: problem+json errors, health, metrics, request ids and timings.

Every response has a request id and a Server-Timing header; `timed` adds parts to the latter.
"""

import re
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import (
    AbstractAsyncContextManager,
    asynccontextmanager,
    contextmanager,
    nullcontext,
)
from dataclasses import dataclass
from functools import cache, partial
from http import HTTPStatus

import structlog
from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Histogram,
    generate_latest,
)
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dextouch import __version__
from dextouch.errors import DexTouchError, InvalidInputError, UnavailableError
from dextouch.schemas import (
    CLASS_OF_STATUS,
    PROBLEM_MEDIA_TYPE,
    Health,
    Problem,
    Readiness,
    problem_from_error,
)
from dextouch.serving.documentation import document_service
from dextouch.serving.guard import AccessControl, Admits, BodyRules, GuardMiddleware, SitePolicy
from dextouch.serving.settings import ServiceSettings

logger = structlog.get_logger(__name__)

REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
OWN_HEADERS = frozenset({b"x-request-id", b"server-timing"})
KNOWN_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
# A body of 1 MiB can hold 500,000 mistakes.
MAX_MISTAKES = 10
SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)

Lifespan = Callable[[FastAPI], AbstractAsyncContextManager[None]]
# Names of what is missing before requests are accepted; empty when ready.
ReadinessCheck = Callable[[], Awaitable[Sequence[str]]]
# Finds the ASGI application that answers a request in place of its route, which takes some 0.4 ms
# of FastAPI's time; None leaves the request to the route. It checks the scope of the key itself,
# sets `scope["route"]`, raises DexTouch errors like a route, and sends nothing before it succeeds.
Shortcut = Callable[[Scope], ASGIApp | None]


def create_service_app(
    *,
    name: str,
    settings: ServiceSettings,
    routers: Sequence[APIRouter],
    lifespan: Lifespan | None = None,
    readiness: ReadinessCheck | None = None,
    admits: Admits | None = None,
) -> FastAPI:
    """Create the application of one service.

    Args:
        name: of the service, in health, logs and titles.
        settings: keys, limits, host names and origins.
        routers: routes of the service; they raise DexTouch errors only.
        lifespan: context of the application (pools, workers).
        readiness: called by /readyz; returns the names of what is missing.
        admits: accepts requests without a key, such as those of signed-in browsers.

    Returns:
        The application; `app.state.registry` accepts further metrics, `app.state.refusal_page`
        renders a refusal as an HTML page, and `app.state.shortcut` answers some requests in place
        of their route (see `Shortcut`).
    """
    app = FastAPI(
        title=name,
        version=__version__,
        docs_url=None,
        redoc_url=None,
        lifespan=_started(lifespan),
        # Services have metrics and logs of their own.
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    app.state.settings = settings
    app.state.access = AccessControl(settings.api_keys)
    app.state.registry = CollectorRegistry()
    app.state.shortcut = None
    app.state.running = False
    # The last one added is outermost, so that refusals of the guard have request ids and are
    # counted, and the shortcut gets no request that the guard refuses.
    app.add_middleware(ShortcutMiddleware)
    app.add_middleware(
        GuardMiddleware,
        access=app.state.access,
        site=SitePolicy(settings.allowed_hosts, settings.allowed_origins),
        bodies=BodyRules(routers, max_body_bytes=settings.max_body_bytes),
        refuse=_refusal,
        admits=admits,
    )
    app.add_middleware(RequestMiddleware, registry=app.state.registry)
    _add_error_handlers(app)
    app.include_router(_health_router(name, readiness))
    for router in routers:
        app.include_router(router)
    app.openapi = partial(  # type: ignore[method-assign]
        document_service, app, routers, needs_key=app.state.access.has_keys
    )
    return app


def _started(lifespan: Lifespan | None) -> Lifespan:
    """Mark the application as running during its lifespan."""

    @asynccontextmanager
    async def around(app: FastAPI) -> AsyncIterator[None]:
        async with nullcontext() if lifespan is None else lifespan(app):
            app.state.running = True
            yield
            app.state.running = False

    return around


def _health_router(name: str, readiness: ReadinessCheck | None) -> APIRouter:
    router = APIRouter(tags=["health"])

    @router.get("/healthz")
    async def healthz() -> Health:
        """Liveness probe."""
        return Health(service=name, version=__version__)

    @router.get("/readyz", responses={503: {"model": Readiness}})
    async def readyz(request: Request, response: Response) -> Readiness:
        """Readiness probe."""
        waiting = [] if request.app.state.running else ["start"]
        if not waiting and readiness is not None:
            waiting = list(await readiness())
        response.status_code = HTTPStatus.SERVICE_UNAVAILABLE if waiting else HTTPStatus.OK
        return Readiness(ready=not waiting, service=name, waiting_for=tuple(waiting))

    @router.get("/metrics", include_in_schema=False)
    async def metrics(request: Request) -> Response:
        """Metrics in Prometheus text format."""
        text = generate_latest(request.app.state.registry)
        return Response(text, headers={"content-type": CONTENT_TYPE_LATEST})

    return router


def _add_error_handlers(app: FastAPI) -> None:
    @app.exception_handler(DexTouchError)
    async def ours(request: Request, error: DexTouchError) -> Response:
        return _problem_response(request, error)

    @app.exception_handler(RequestValidationError)
    async def validation(request: Request, error: RequestValidationError) -> Response:
        found = error.errors()
        items = [
            {"where": ".".join(str(part) for part in item["loc"]), "what": str(item["msg"])}
            for item in found[:MAX_MISTAKES]
        ]
        malformed = any(item["type"] == "json_invalid" for item in found[:MAX_MISTAKES])
        text = "; ".join(f"{item['where']}: {item['what']}" for item in items)
        if len(found) > len(items):
            text += f"; and {len(found) - len(items)} more"
        ours = InvalidInputError(text or "invalid request", errors=items)
        return _problem_response(request, ours, 400 if malformed else 422)

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> Response:
        return _refusal(request, error)

    @app.exception_handler(Exception)
    async def unexpected(request: Request, error: Exception) -> Response:
        # Starlette re-raises it after this response, for the server's log.
        logger.error("request_failed", path=request.url.path, error=type(error).__name__)
        ours = DexTouchError(
            "unexpected error in the service; see the service's log for the request id"
        )
        response = _problem_response(request, ours)
        response.headers["x-request-id"] = request.state.request_id
        return response


def _refusal(request: Request, error: DexTouchError | HTTPException) -> Response:
    if isinstance(error, DexTouchError):
        page = getattr(request.app.state, "refusal_page", None)
        if page is not None and "text/html" in request.headers.get("accept", ""):
            shown: Response = page(request, error)
            return shown
        return _problem_response(request, error)
    kind = CLASS_OF_STATUS.get(error.status_code, UnavailableError)
    ours = kind(f"{request.method} {request.url.path}: {error.detail}")
    response = _problem_response(request, ours, error.status_code)
    response.headers.update(error.headers or {})
    return response


def _problem_response(
    request: Request, error: DexTouchError, status: int | None = None
) -> Response:
    problem: Problem = problem_from_error(
        error, instance=request.url.path, request_id=request.state.request_id
    )
    if status is not None:
        problem = problem.model_copy(update={"status": status})
    headers = {}
    if "retry_after_s" in error.details:
        headers["retry-after"] = str(error.details["retry_after_s"])
    if problem.status == HTTPStatus.UNAUTHORIZED:
        headers["www-authenticate"] = "Bearer"
    return JSONResponse(
        problem.model_dump(), problem.status, headers=headers, media_type=PROBLEM_MEDIA_TYPE
    )


@dataclass(frozen=True)
class ShortcutMiddleware:
    """ASGI middleware that lets a shortcut answer the requests that it knows."""

    app: ASGIApp

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; other scopes (lifespan, websocket) pass through."""
        shortcut: Shortcut | None = scope["app"].state.shortcut
        direct = shortcut(scope) if shortcut is not None and scope["type"] == "http" else None
        if direct is None:
            await self.app(scope, receive, send)
            return
        try:
            await direct(scope, receive, send)
        except DexTouchError as error:
            await _problem_response(Request(scope), error)(scope, receive, send)
        except HTTPException as error:
            await _refusal(Request(scope), error)(scope, receive, send)


class RequestMiddleware:
    """Sets `request.state.request_id` and `.timings_s`, the headers for them, and counts requests.

    The counters belong to the given Prometheus registry.
    """

    def __init__(self, app: ASGIApp, *, registry: CollectorRegistry) -> None:
        self._app = app
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
        self._counter = cache(self._requests.labels)
        self._part_histogram = cache(self._parts_seconds.labels)
        self._histogram = cache(self._seconds.labels)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; other scopes (lifespan, websocket) pass through."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()
        request_id = _request_id(scope)
        timings_s: dict[str, float] = {}
        scope.setdefault("state", {}).update(request_id=request_id, timings_s=timings_s)

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                duration_s = time.perf_counter() - started
                timings = [f"{part};dur={spent_s * 1e3:.2f}" for part, spent_s in timings_s.items()]
                timings.append(f"total;dur={duration_s * 1e3:.2f}")
                message["headers"] = [
                    *(
                        header
                        for header in message.get("headers", ())
                        if header[0] not in OWN_HEADERS
                    ),
                    (b"x-request-id", request_id.encode()),
                    (b"server-timing", ", ".join(timings).encode()),
                ]
                self._count(scope, message["status"], duration_s, timings_s)
            await send(message)

        tokens = structlog.contextvars.bind_contextvars(request_id=request_id)
        try:
            await self._app(scope, receive, send_with_headers)
        finally:
            structlog.contextvars.reset_contextvars(**tokens)

    def _count(
        self, scope: Scope, status: int, duration_s: float, timings_s: Mapping[str, float]
    ) -> None:
        # The route template, not the path, to keep the number of labels bounded.
        route = getattr(scope.get("route"), "path", "unmatched")
        method = scope["method"] if scope["method"] in KNOWN_METHODS else "OTHER"
        self._counter(method, route, str(status)).inc()
        self._histogram(method, route).observe(duration_s)
        for part, spent_s in timings_s.items():
            self._part_histogram(route, part).observe(spent_s)


def _request_id(scope: Scope) -> str:
    """The caller's, if it is a valid one, or a new one."""
    for name, value in scope["headers"]:
        if name == b"x-request-id":
            given = value.decode("latin-1")
            return given if REQUEST_ID.fullmatch(given) else secrets.token_hex(16)
    return secrets.token_hex(16)


@contextmanager
def timed(request: Request, part: str) -> Iterator[None]:
    """Time a part of a request (`queue`, `device`, `encode`, …) for its Server-Timing header."""
    started = time.perf_counter()
    try:
        yield
    finally:
        timings_s: dict[str, float] = request.state.timings_s
        timings_s[part] = timings_s.get(part, 0.0) + time.perf_counter() - started
