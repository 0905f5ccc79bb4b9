"""What a service lets in: host name and origin, a key, media type and size of the body.

Browsers let any page send requests to any address (CSRF), and with DNS rebinding a page can even
read the responses. So a request without a key must come from a page of this service, or not from a
page at all.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from http import HTTPStatus
from typing import Generic, TypeVar

from fastapi import APIRouter
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dextouch.errors import AccessDeniedError, DexTouchError, InvalidInputError
from dextouch.schemas import MAX_NAMED, first_problems, status_of
from dextouch.serving.keys import AccessControl, no_key, not_signed_in, presented_key
from dextouch.serving.refusals import RefusalLog, WrongKeys
from dextouch.serving.settings import canonical_host, canonical_origin, is_loopback

HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9_.-]+))(?::\d{1,5})?")
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
# By which a page of another site is recognised.
SENDER_HEADERS = (b"host", b"origin", b"sec-fetch-site")
# Of a scope: the headers by name, which are looked up several times.
FIRST_HEADERS = "dextouch.first_headers"
# Health checks and Prometheus have no key, and use container names as host.
PROBES = frozenset({"/healthz", "/readyz", "/metrics"})
POLICY_VIOLATION = 1008
MAX_REASON_BYTES = 123

JSON = "application/json"
MSGPACK = "application/msgpack"
OCTETS = "application/octet-stream"
FORM = "application/x-www-form-urlencoded"
KIB = 2**10
# For bodies of variable size: the limit is the setting max_body_bytes.
AS_SET = 2**63
RULE_ATTRIBUTE = "__dextouch_body_rule__"
EndpointT = TypeVar("EndpointT", bound=Callable[..., object])

# Whether a request without a key comes from a signed-in browser.
Admits = Callable[[HTTPConnection], bool]
Refuse = Callable[[Request, DexTouchError | HTTPException], Response]


def close_reason(message: str) -> str:
    """As much of a message as the close frame of a WebSocket holds (RFC 6455, section 5.5)."""
    return message.encode()[:MAX_REASON_BYTES].decode(errors="ignore")


def header(scope: Scope, name: bytes) -> str | None:
    """First header of a lower-case name, as `starlette.datastructures.Headers.get`, but quicker."""
    found = scope.get(FIRST_HEADERS)
    if found is None:
        found = scope[FIRST_HEADERS] = dict(scope["headers"][::-1])
    value = found.get(name)
    return None if value is None else str(value, "latin-1")


@dataclass(frozen=True)
class SitePolicy:
    """The service's own host names and origins, besides loopback names and the request's own."""

    hosts: Sequence[str]
    origins: Sequence[str]

    def check(self, scope: Scope, *, is_unsafe: bool) -> None:
        """Refuse pages of other sites; unsafe is what may change state, or opens a WebSocket."""
        sent = tuple([(name, one) for name, one in scope["headers"] if name in SENDER_HEADERS])
        self._check_once(scope["scheme"], sent, is_unsafe=is_unsafe)

    @cached_property
    def _check_once(self) -> Callable[..., None]:
        """As `_check`, for senders that it has just admitted without another look."""
        return lru_cache(maxsize=64)(self._check)

    def _check(self, scheme: str, sent: Sequence[tuple[bytes, bytes]], *, is_unsafe: bool) -> None:
        hosts, origins, sites = (
            [value.decode("latin-1").lower() for name, value in sent if name == wanted]
            for wanted in SENDER_HEADERS
        )
        host = ", ".join(hosts)
        self._check_host(host)
        if not is_unsafe:
            return
        # Of a WebSocket the scheme is ws or wss, of its page http or https.
        own = _canonical(f"{scheme.replace('ws', 'http')}://{host}")
        if origins:
            origin = ", ".join(origins)
            if _canonical(origin) not in {own, *self.origins}:
                raise _foreign_origin(f"origin {origin!r}", own)
            return
        site = sites[0] if sites else "none"
        if site in {"cross-site", "same-site"}:
            raise _foreign_origin(f"a page of another origin (Sec-Fetch-Site: {site})", own)

    def _check_host(self, host: str) -> None:
        name = ""
        if parts := HOST.fullmatch(host):
            with suppress(ValueError):
                name = canonical_host(parts[1] or parts[2])
        if name not in self.hosts and not is_loopback(name):
            raise AccessDeniedError(
                f"host: got {host!r}, expected a loopback name or one of the setting "
                f"allowed_hosts ({', '.join(sorted(self.hosts)) or 'none'}); "
                "add the name there if browsers or tools are to use it",
                reason="foreign_host",
            )


def _canonical(origin: str) -> str:
    with suppress(ValueError):
        return canonical_origin(origin)
    return origin


def _foreign_origin(got: str, own: str) -> AccessDeniedError:
    return AccessDeniedError(
        f"got a request of {got}, expected one of {own} or of the setting allowed_origins",
        reason="foreign_origin",
    )


@dataclass(frozen=True)
class BodyRule:
    """Maximum body size in bytes by media type; `needs_key` is False only for signing in.

    `model` documents a JSON body that the route decodes by itself.
    """

    max_bytes: Mapping[str, int]
    needs_key: bool = True
    model: type[BaseModel] | None = None


# Default limit: room for names and options, not for data.
DEFAULT_RULE = BodyRule({JSON: 64 * KIB})
# The router responds with 404 or 405 without reading the body.
NO_ROUTE = BodyRule({})


def takes(
    max_bytes: Mapping[str, int], *, needs_key: bool = True, model: type[BaseModel] | None = None
) -> Callable[[EndpointT], EndpointT]:
    """Decorator that declares the bodies a route accepts, placed directly above the function.

    Routes without it accept JSON of at most 64 KiB. Other media types are refused with 415, bodies
    larger than `max_bytes` of their type (such as `{JSON: 4 * KIB, MSGPACK: AS_SET}`) with 413,
    both before the body is read. `needs_key` is False if the route can be called without a key.
    `model` documents a JSON body that the route decodes by itself.
    """

    def mark(endpoint: EndpointT) -> EndpointT:
        setattr(endpoint, RULE_ATTRIBUTE, BodyRule(max_bytes, needs_key, model))
        return endpoint

    return mark


def body_rule(endpoint: Callable[..., object]) -> BodyRule | None:
    """What `takes` declared of a route; None without it."""
    return getattr(endpoint, RULE_ATTRIBUTE, None)


@lru_cache(maxsize=64)
def media_type(content_type: str | None) -> tuple[str, dict[str, str]]:
    """A Content-Type's media type and parameters in lower case; "none" where there is none.

    Values end at a semicolon also within quotes: no parameter that is read may have one.
    """
    kind, *given = [part.strip() for part in (content_type or "none").lower().split(";")]
    pairs = (parameter.partition("=") for parameter in given)
    return kind, {name.strip(): value.strip().strip('"') for name, _, value in pairs}


@dataclass(frozen=True)
class RequireScope:
    """Route dependency that requires a scope: `dependencies=[Depends(RequireScope("rollout"))]`."""

    scope: str

    async def __call__(self, request: Request) -> str:
        """The name of the caller's key; raises AccessDeniedError."""
        access: AccessControl = request.app.state.access
        return access.check(request.headers.get("authorization"), self.scope)


class BodyRules:
    """The rules of all routes of a service."""

    def __init__(self, routers: Sequence[APIRouter], *, max_body_bytes: int) -> None:
        self._rules = [
            (
                route.path_regex,
                frozenset(route.methods or ()),
                body_rule(route.endpoint) or DEFAULT_RULE,
            )
            for router in routers
            for route in router.routes
            if isinstance(route, APIRoute)
        ]
        self._max_body_bytes = max_body_bytes

    def rule_of(self, scope: Scope) -> BodyRule:
        """The rule of the route that matches a request."""
        for path_regex, methods, rule in self._rules:
            if scope["method"] in methods and path_regex.match(scope["path"]):
                return rule
        return NO_ROUTE

    def limited(self, receive: Receive, scope: Scope, rule: BodyRule) -> Receive:
        """Wrap `receive` to enforce the limit, with or without Content-Length."""
        length = header(scope, b"content-length")
        announced = "0" if length is None else length
        limit = self._limit(scope, rule, announced)
        received = 0
        is_complete = False

        def check(num_bytes: int) -> None:
            if num_bytes > limit:
                # Starlette's own class, since FastAPI turns any other into a 400.
                raise HTTPException(413, f"body: got {num_bytes} bytes, expected at most {limit}")

        async def limited() -> Message:
            nonlocal received, is_complete
            message = await receive()
            if message["type"] == "http.disconnect" and not is_complete:
                # Nobody reads this response; a ClientDisconnect would be logged as our mistake.
                raise HTTPException(400, "body: the connection ended before the body")
            is_complete = not message.get("more_body", False)
            received += len(message.get("body", b""))
            check(received)
            return message

        check(int(announced) if announced.isdecimal() else 0)
        return limited

    def _limit(self, scope: Scope, rule: BodyRule, announced: str) -> int:
        if not rule.max_bytes:
            return self._max_body_bytes
        largest = min(max(rule.max_bytes.values()), self._max_body_bytes)
        if announced == "0" and header(scope, b"transfer-encoding") is None:
            return largest
        got, _ = media_type(header(scope, b"content-type"))
        if got not in rule.max_bytes:
            raise HTTPException(
                415, f"body: got Content-Type {got!r}, expected {' or '.join(rule.max_bytes)}"
            )
        return min(rule.max_bytes[got], self._max_body_bytes)


@dataclass(frozen=True)
class GuardMiddleware:
    """ASGI middleware that refuses requests and WebSockets before a body is read.

    `refuse` makes the response to a refused request; `admits` is None if every request needs a key.
    """

    app: ASGIApp
    access: AccessControl
    site: SitePolicy
    bodies: BodyRules
    refuse: Refuse
    wrong_keys: WrongKeys
    refusals: RefusalLog
    admits: Admits | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request or WebSocket."""
        if scope["type"] == "http":
            rule, is_unsafe = self.bodies.rule_of(scope), scope["method"] not in SAFE_METHODS
            try:
                self._check_sender(scope, needs_key=rule.needs_key, is_unsafe=is_unsafe)
                receive = self.bodies.limited(receive, scope, rule)
            except (DexTouchError, HTTPException) as error:
                await self.refuse(Request(scope), error)(scope, receive, send)
                return
        elif scope["type"] == "websocket":
            try:
                self._check_sender(scope, needs_key=True, is_unsafe=True)
            except AccessDeniedError as error:
                await self._refuse_websocket(error, scope, receive, send)
                return
        await self.app(scope, receive, send)

    async def _refuse_websocket(
        self, error: AccessDeniedError, scope: Scope, receive: Receive, send: Send
    ) -> None:
        status = status_of(error)
        self.refusals.note(HTTPConnection(scope), status, str(error.details["reason"]))
        can_answer = "websocket.http.response" in scope.get("extensions", {})
        if status == HTTPStatus.TOO_MANY_REQUESTS and can_answer:
            # A WebSocket that is closed before it is accepted is answered with 403.
            waits = {"retry-after": str(error.details["retry_after_s"])}
            await PlainTextResponse(error.message, status, waits)(scope, receive, send)
            return
        reason = close_reason(error.message)
        await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": reason})

    def _check_sender(self, scope: Scope, *, needs_key: bool, is_unsafe: bool) -> None:
        if self.access.has_keys:
            authorization = header(scope, b"authorization")
            # A foreign page cannot know a key, so host and origin do not matter with one.
            if scope["path"] in PROBES or self.access.find(authorization) is not None:
                return
            connection = HTTPConnection(scope)
            signed_in = self.admits is not None and self.admits(connection)
            if not signed_in and presented_key(authorization) is not None:
                self.wrong_keys.count(connection)
            if is_unsafe and needs_key and not signed_in:
                raise no_key(authorization) if self.admits is None else not_signed_in()
            if self.admits is None:
                return
        self.site.check(scope, is_unsafe=is_unsafe)


ModelT = TypeVar("ModelT", bound=BaseModel)

DecodedT = TypeVar("DecodedT")

# What is larger is decoded in a thread, so that others need not wait.
MAX_INLINE_BYTES = 64 * KIB


async def decoded(decode: Callable[[bytes], DecodedT], body: bytes) -> DecodedT:
    """What `decode` makes of a body or message, in a thread for one of more than 64 KiB."""
    if len(body) <= MAX_INLINE_BYTES:
        return decode(body)
    return await run_in_threadpool(decode, body)


@dataclass(frozen=True)
class JsonBody(Generic[ModelT]):
    """Route dependency for a body of more than 64 KiB: `Depends(JsonBody(RecordingAttributes))`.

    FastAPI decodes on the event loop and describes every mistake, of which 1 MiB can hold 100,000.
    """

    model: type[ModelT]

    async def __call__(self, request: Request) -> ModelT:
        """The body; raises RequestValidationError, or InvalidInputError for too many mistakes."""
        return await decoded(self._decode, await request.body())

    def _decode(self, body: bytes) -> ModelT:
        try:
            return self.model.model_validate(from_json(body) if body else None)
        except ValidationError as error:
            if error.error_count() > MAX_NAMED:
                raise InvalidInputError(f"body: {first_problems(error)}") from None
            mistakes = error.errors(include_url=False)
        except ValueError as error:
            mistakes = [{"type": "json_invalid", "loc": (), "msg": str(error), "input": {}}]
        raise RequestValidationError([{**one, "loc": ("body", *one["loc"])} for one in mistakes])
