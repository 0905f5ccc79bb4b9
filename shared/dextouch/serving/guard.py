"""Admission of requests and WebSockets: host name, origin, key and body limit.

Browsers let any page send requests to any address (CSRF), and with DNS rebinding a page can even
read the responses. So a request without a key must come from a page of this service, or not from a
page at all.
"""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import structlog
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from dextouch.errors import AccessDeniedError, DexTouchError
from dextouch.serving.access import AccessControl, not_signed_in
from dextouch.serving.bodies import BodyLimit, BodyRules
from dextouch.serving.settings import (
    ServiceSettings,
    canonical_host,
    canonical_origin,
    is_loopback,
)

logger = structlog.get_logger(__name__)

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
# Health checks and Prometheus have no key, and use container names as host.
PROBES = frozenset({"/healthz", "/readyz", "/metrics"})
HTTP_SCHEMES = {"ws": "http", "wss": "https"}
HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9_.-]+))(?::\d{1,5})?")
POLICY_VIOLATION = 1008
MAX_REASON_BYTES = 123

# Whether a request without a key comes from a signed-in browser.
Admits = Callable[[HTTPConnection], bool]
Refuse = Callable[[Request, DexTouchError | HTTPException], Response]


class SitePolicy:
    """The service's own host names and origins."""

    def __init__(self, settings: ServiceSettings) -> None:
        self._hosts = frozenset(settings.allowed_hosts)
        self._origins = frozenset(settings.allowed_origins)

    def check(self, connection: HTTPConnection, *, is_unsafe: bool) -> None:
        """Refuse requests from pages of other sites.

        Args:
            connection: the request.
            is_unsafe: whether it may change state or opens a WebSocket.

        Raises:
            AccessDeniedError: a foreign host name or origin (see `reason`).
        """
        host = ", ".join(connection.headers.getlist("host")).lower()
        self._check_host(host)
        if not is_unsafe:
            return
        scheme = str(connection.scope["scheme"])
        scheme = HTTP_SCHEMES.get(scheme, scheme)
        own = _canonical(f"{scheme}://{host}")
        if "origin" in connection.headers:
            origin = ", ".join(connection.headers.getlist("origin")).lower()
            if _canonical(origin) not in {own, *self._origins}:
                raise _foreign_origin(f"origin {origin!r}", own)
            return
        site = connection.headers.get("sec-fetch-site", "none").lower()
        if site in {"cross-site", "same-site"}:
            raise _foreign_origin(f"a page of another origin (Sec-Fetch-Site: {site})", own)

    def _check_host(self, host: str) -> None:
        parts = HOST.fullmatch(host)
        name = ""
        if parts is not None:
            with suppress(ValueError):
                name = canonical_host(parts[1] or parts[2])
        if name not in self._hosts and not is_loopback(name):
            raise AccessDeniedError(
                f"host: got {host!r}, expected a loopback name or one of the setting "
                f"allowed_hosts ({', '.join(sorted(self._hosts)) or 'none'}); "
                "add the name there if browsers or tools are to use it",
                reason="foreign_host",
            )


@dataclass(frozen=True)
class Guard:
    """Admission checks of a service, and the response to a refused request.

    `admits` is None if every request needs a key.
    """

    access: AccessControl
    site: SitePolicy
    bodies: BodyRules
    refuse: Refuse
    admits: Admits | None = None

    def check_sender(self, connection: HTTPConnection, *, needs_key: bool, is_unsafe: bool) -> None:
        """Refuse foreign pages, and unsafe requests without a key.

        Raises:
            AccessDeniedError: with the reason.
        """
        if self.access.has_keys:
            authorization = connection.headers.get("authorization")
            # A foreign page cannot know a key, so host and origin do not matter with one.
            if connection.scope["path"] in PROBES or self.access.knows(authorization):
                return
            signed_in = self.admits is not None and self.admits(connection)
            if is_unsafe and needs_key and not signed_in:
                if self.admits is not None:
                    raise not_signed_in()
                self.access.identify(authorization)
            if self.admits is None:
                return
        self.site.check(connection, is_unsafe=is_unsafe)


class GuardMiddleware:
    """ASGI middleware that applies a guard before the body is read."""

    def __init__(self, app: ASGIApp, *, guard: Guard) -> None:
        self._app = app
        self._guard = guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request or WebSocket."""
        if scope["type"] == "http":
            await self._http(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope)
        rule = self._guard.bodies.rule_of(scope)
        is_unsafe = scope["method"] not in SAFE_METHODS
        try:
            self._guard.check_sender(request, needs_key=rule.needs_key, is_unsafe=is_unsafe)
            max_bytes = self._guard.bodies.limit(request.headers, rule)
            limited = BodyLimit(receive, request.headers, max_bytes)
        except (DexTouchError, HTTPException) as error:
            response = self._guard.refuse(request, error)
            await response(scope, receive, send)
            return
        await self._app(scope, limited, send)

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            self._guard.check_sender(HTTPConnection(scope), needs_key=True, is_unsafe=True)
        except AccessDeniedError as error:
            logger.warning("websocket_refused", path=scope["path"], error=error.message)
            reason = error.message.encode()[:MAX_REASON_BYTES].decode(errors="ignore")
            await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": reason})
            return
        await self._app(scope, receive, send)


def _canonical(origin: str) -> str:
    try:
        return canonical_origin(origin)
    except ValueError:
        return origin


def _foreign_origin(got: str, own: str) -> AccessDeniedError:
    return AccessDeniedError(
        f"got a request of {got}, expected one of {own} or of the setting allowed_origins",
        reason="foreign_origin",
    )
