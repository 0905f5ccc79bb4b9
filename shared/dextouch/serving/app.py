"""Factory of service applications: middleware, problem+json errors, health and metrics."""

from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from functools import partial
from http import HTTPStatus
from operator import attrgetter

import structlog
from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Info,
    ProcessCollector,
    generate_latest,
)
from starlette.exceptions import HTTPException
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from dextouch import __version__
from dextouch.errors import DexTouchError, InvalidInputError, UnavailableError
from dextouch.schemas import (
    CLASS_OF_STATUS,
    PROBLEM_MEDIA_TYPE,
    Health,
    Problem,
    Readiness,
    problem_from_error,
    status_of,
)
from dextouch.serving.api_page import api_page_router
from dextouch.serving.connections import RequestMiddleware, ShortcutMiddleware
from dextouch.serving.guard import Admits, BodyRules, GuardMiddleware, SitePolicy
from dextouch.serving.keys import AccessControl
from dextouch.serving.logs import hide_secrets, masked
from dextouch.serving.openapi import DESCRIPTION, document_service
from dextouch.serving.refusals import REFUSED, RefusalLog, WrongKeys
from dextouch.serving.served_folder import ServedFolder
from dextouch.serving.settings import ServiceSettings

logger = structlog.get_logger(__name__)

# A body of 1 MiB can hold 500,000 mistakes.
MAX_MISTAKES = 10

Lifespan = Callable[[FastAPI], AbstractAsyncContextManager[None]]
# Names of what is missing before requests are accepted; empty when ready.
ReadinessCheck = Callable[[], Awaitable[Sequence[str]]]


def create_service_app(  # noqa: PLR0913 - all by name
    *,
    name: str,
    settings: ServiceSettings,
    routers: Sequence[APIRouter],
    lifespan: Lifespan | None = None,
    readiness: ReadinessCheck | None = None,
    admits: Admits | None = None,
    folders: Sequence[ServedFolder] = (),
) -> FastAPI:
    """Create the application of one service, whose routes raise DexTouch errors only.

    `readiness` is called by /readyz and returns the names of what is missing. `admits` accepts
    requests without a key, such as those of signed-in browsers. All routes need the `folders`; the
    service is not ready without them.

    `app.state.registry` of the application accepts further metrics, `app.state.refusal_page`
    renders a refusal or an error as an HTML page for browsers, and `app.state.shortcut` answers
    some requests in place of their route (see `Shortcut`).
    """
    hide_secrets(settings)
    app = FastAPI(
        title=name,
        version=__version__,
        description=DESCRIPTION,
        # Operation ids, by which generated clients name their functions.
        generate_unique_id_function=attrgetter("name"),
        docs_url=None,
        redoc_url=None,
        lifespan=_started(lifespan, folders),
        # Services have metrics and logs of their own.
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    app.state.settings = settings
    app.state.access = AccessControl(settings.api_keys)
    app.state.wrong_keys = WrongKeys()
    app.state.refusals = RefusalLog(app.state.access)
    app.state.registry = CollectorRegistry()
    ProcessCollector(registry=app.state.registry)
    about = Info("dextouch_build", "Name and version of the service.", registry=app.state.registry)
    about.info({"service": name, "version": __version__})
    app.state.shortcut = None
    app.state.running = False
    # Why the application could not start.
    app.state.start_error = None
    # The last one added is outermost, so that refusals of the guard have request ids and are
    # counted, and the shortcut gets no request that the guard refuses.
    app.add_middleware(ShortcutMiddleware, refuse=_refusal)
    app.add_middleware(
        GuardMiddleware,
        access=app.state.access,
        site=SitePolicy(settings.allowed_hosts, settings.allowed_origins),
        bodies=BodyRules(routers, max_body_bytes=settings.max_body_bytes),
        refuse=_refusal,
        wrong_keys=app.state.wrong_keys,
        refusals=app.state.refusals,
        admits=admits,
    )
    app.add_middleware(RequestMiddleware, registry=app.state.registry)
    if settings.trusted_proxies:
        app.add_middleware(ProxyHeadersMiddleware, trusted_hosts=list(settings.trusted_proxies))
    _add_error_handlers(app)
    app.include_router(_health_router(name, readiness, folders))
    app.include_router(api_page_router())
    for router in routers:
        app.include_router(router, dependencies=[Depends(folder.required) for folder in folders])
    app.openapi = partial(  # type: ignore[method-assign]
        document_service, app, routers, needs_key=app.state.access.has_keys
    )
    return app


def _started(lifespan: Lifespan | None, folders: Sequence[ServedFolder]) -> Lifespan:
    @asynccontextmanager
    async def around(app: FastAPI) -> AsyncIterator[None]:
        for folder in folders:
            try:
                folder.open()
            except UnavailableError as error:
                # It serves what does not need the folder, such as why it is not ready.
                logger.error("folder_unusable", reason=error.message)  # noqa: TRY400
        async with AsyncExitStack() as opened:
            try:
                if lifespan is not None:
                    await opened.enter_async_context(lifespan(app))
            except DexTouchError as error:
                app.state.start_error = error
                raise
            app.state.running = True
            yield
            app.state.running = False

    return around


def _health_router(
    name: str, readiness: ReadinessCheck | None, folders: Sequence[ServedFolder]
) -> APIRouter:
    router = APIRouter(tags=["health"])

    @router.head("/healthz", include_in_schema=False)
    @router.get("/healthz")
    async def check_liveness() -> Health:
        """Liveness probe."""
        return Health(service=name, version=__version__)

    @router.head("/readyz", include_in_schema=False)
    @router.get("/readyz", responses={503: {"model": Readiness}})
    async def check_readiness(request: Request, response: Response) -> Readiness:
        """Readiness probe."""
        waiting = [] if request.app.state.running else ["start"]
        if not waiting:
            problems = [folder.problem(writing=True) for folder in folders]
            waiting = [problem for problem in problems if problem is not None]
            waiting += [] if readiness is None else await readiness()
        response.status_code = HTTPStatus.SERVICE_UNAVAILABLE if waiting else HTTPStatus.OK
        return Readiness(ready=not waiting, service=name, waiting_for=tuple(waiting))

    @router.get("/metrics", include_in_schema=False)
    def get_metrics(request: Request) -> Response:
        """Metrics in Prometheus text format, made in a thread since some ask the disk."""
        text = generate_latest(request.app.state.registry)
        return Response(text, headers={"content-type": CONTENT_TYPE_LATEST})

    return router


def _add_error_handlers(app: FastAPI) -> None:
    @app.exception_handler(DexTouchError)
    @app.exception_handler(HTTPException)
    async def refused(request: Request, error: DexTouchError | HTTPException) -> Response:
        return _refusal(request, error)

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
        return _page_or_problem(request, error, status_of(error))
    kind = CLASS_OF_STATUS.get(error.status_code, UnavailableError)
    ours = kind(f"{request.method} {request.url.path}: {error.detail}")
    response = _page_or_problem(request, ours, error.status_code)
    response.headers.update(error.headers or {})
    return response


def _page_or_problem(request: Request, error: DexTouchError, status: int) -> Response:
    if status in REFUSED:
        reason = error.details.get("reason", type(error).__name__)
        request.app.state.refusals.note(request, status, str(reason))
    page = getattr(request.app.state, "refusal_page", None)
    if page is not None and "text/html" in request.headers.get("accept", ""):
        response: Response = page(masked(error.message), status)
        return response
    return _problem_response(request, error, status)


def _problem_response(
    request: Request, error: DexTouchError, status: int | None = None
) -> Response:
    problem: Problem = problem_from_error(
        error, instance=request.url.path, request_id=request.state.request_id
    )
    changed = {"trace_id": request.state.trace_id}
    problem = problem.model_copy(update=changed | ({} if status is None else {"status": status}))
    headers = {}
    if "retry_after_s" in error.details:
        headers["retry-after"] = str(error.details["retry_after_s"])
    if problem.status == HTTPStatus.UNAUTHORIZED:
        headers["www-authenticate"] = "Bearer"
    return Response(
        masked(problem.model_dump_json()),
        problem.status,
        headers=headers,
        media_type=PROBLEM_MEDIA_TYPE,
    )
