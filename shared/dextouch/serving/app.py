"""Factory of service applications: middleware, problem+json errors, health, metrics, OpenAPI.

FastAPI documents parameters, models and successful responses. The rest follows from the routes:
`RequireScope` the security scheme, `takes` the request body, method and parameters the refusals.
"""

from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from functools import partial
from http import HTTPStatus
from typing import Any, TypeVar

import structlog
from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.dependencies.models import Dependant
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
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
from dextouch.serving.connections import RequestMiddleware, ShortcutMiddleware
from dextouch.serving.guard import (
    JSON,
    SAFE_METHODS,
    Admits,
    BodyRules,
    GuardMiddleware,
    JsonBody,
    RequireScope,
    SitePolicy,
    body_rule,
)
from dextouch.serving.keys import AccessControl
from dextouch.serving.logs import hide_secrets, masked
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

    @router.get("/healthz")
    async def healthz() -> Health:
        """Liveness probe."""
        return Health(service=name, version=__version__)

    @router.get("/readyz", responses={503: {"model": Readiness}})
    async def readyz(request: Request, response: Response) -> Readiness:
        """Readiness probe."""
        waiting = [] if request.app.state.running else ["start"]
        if not waiting:
            problems = [folder.problem(writing=True) for folder in folders]
            waiting = [problem for problem in problems if problem is not None]
            waiting += [] if readiness is None else await readiness()
        response.status_code = HTTPStatus.SERVICE_UNAVAILABLE if waiting else HTTPStatus.OK
        return Readiness(ready=not waiting, service=name, waiting_for=tuple(waiting))

    @router.get("/metrics", include_in_schema=False)
    def metrics(request: Request) -> Response:
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
        shown: Response = page(masked(error.message), status)
        return shown
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


CallT = TypeVar("CallT")
KEY_SCHEME = "api_key"
BEARER = {"type": "http", "scheme": "bearer", "description": "A key of the service's settings."}
BINARY = {"type": "string", "format": "binary"}
PROBLEM_CONTENT = {PROBLEM_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}

# The server, the guard and the error handlers can give these on any route (413 and 415 also where a
# GET has a body), and on those that change something.
OF_ANY = frozenset({408, 413, 415, 421, 429, 431, 500, 503})
OF_CHANGES = frozenset({403, 404, 409, 422, 507})


def document_service(
    app: FastAPI, routers: Sequence[APIRouter], *, needs_key: bool
) -> dict[str, Any]:
    """The OpenAPI document of a service, made once; without keys of the service a key is optional.

    A route declares further refusals by `responses={406: {}}`.
    """
    if app.openapi_schema is not None:
        return app.openapi_schema
    document = FastAPI.openapi(app)
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    schemas["Problem"] = Problem.model_json_schema()
    # Of FastAPI's own 422, which no service gives.
    schemas.pop("HTTPValidationError", None)
    schemas.pop("ValidationError", None)
    for operation, route, method in _operations(document, routers):
        needed = _dependencies(route.dependant, RequireScope)
        scopes = list(dict.fromkeys(one.scope for one in needed))
        if scopes:
            document["components"].setdefault("securitySchemes", {})[KEY_SCHEME] = BEARER
            keyed = {KEY_SCHEME: scopes}
            operation["security"] = [keyed] if needs_key else [keyed, {}]
        for body in _dependencies(route.dependant, JsonBody):
            schema = body.model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= schema.pop("$defs", {})
            operation["requestBody"] = {"required": True, "content": {JSON: {"schema": schema}}}
        rule = body_rule(route.endpoint)
        if rule is not None and rule.max_bytes:
            # Media types that the route takes and reads by itself.
            body_of = operation.setdefault("requestBody", {"required": True})
            for kind in rule.max_bytes:
                schema = {} if kind == JSON else {"schema": BINARY}
                body_of.setdefault("content", {}).setdefault(kind, schema)
        _document_refusals(operation, method, has_scope=bool(scopes))
    return document


def _operations(
    document: dict[str, Any], routers: Sequence[APIRouter]
) -> Iterator[tuple[dict[str, Any], APIRoute, str]]:
    """Operations of the document with their routes and methods."""
    for router in routers:
        for route in router.routes:
            if isinstance(route, APIRoute) and route.include_in_schema and router.include_in_schema:
                for method in route.methods or ():
                    yield document["paths"][route.path_format][method.lower()], route, method


def _dependencies(dependant: Dependant, kind: type[CallT]) -> Iterator[CallT]:
    for dependency in dependant.dependencies:
        if isinstance(dependency.call, kind):
            yield dependency.call
        yield from _dependencies(dependency, kind)


def _document_refusals(operation: dict[str, Any], method: str, *, has_scope: bool) -> None:
    responses = operation.setdefault("responses", {})
    statuses = set(OF_ANY)
    if "security" in operation:
        statuses.add(401)
    if has_scope:
        statuses.add(403)
    if method not in SAFE_METHODS:
        statuses |= OF_CHANGES
    if "requestBody" in operation:
        statuses.add(400)
    if operation.get("parameters"):
        statuses.add(422)
    if any(parameter["in"] == "path" for parameter in operation.get("parameters", ())):
        statuses.add(404)
    statuses |= {int(status) for status in responses if int(status) >= 400}
    for status in statuses:
        responses[str(status)] = {
            "description": HTTPStatus(status).phrase,
            "content": PROBLEM_CONTENT,
        }
