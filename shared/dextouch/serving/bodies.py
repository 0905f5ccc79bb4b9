"""Limits of request bodies by route and media type, enforced before a body is read."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from email.message import Message
from typing import TypeVar

from fastapi import APIRouter
from fastapi.routing import APIRoute
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import Message as AsgiMessage
from starlette.types import Receive, Scope

JSON = "application/json"
MSGPACK = "application/msgpack"
OCTETS = "application/octet-stream"
FORM = "application/x-www-form-urlencoded"
KIB = 2**10
# For bodies of variable size: the limit is the setting max_body_bytes.
AS_SET = 2**63
RULE_ATTRIBUTE = "__dextouch_body_rule__"
EndpointT = TypeVar("EndpointT", bound=Callable[..., object])


@dataclass(frozen=True)
class BodyRule:
    """Maximum body size in bytes by media type; `needs_key` is False only for signing in."""

    max_bytes: Mapping[str, int]
    needs_key: bool = True


# Default limit: room for names and options, not for data.
DEFAULT_RULE = BodyRule({JSON: 64 * KIB})
# The router responds with 404 or 405 without reading the body.
NO_ROUTE = BodyRule({})


def takes(
    max_bytes: Mapping[str, int], *, needs_key: bool = True
) -> Callable[[EndpointT], EndpointT]:
    """Decorator that declares the bodies a route accepts, placed directly above the function.

    Routes without it accept JSON of at most 64 KiB. Other media types are refused with 415, larger
    bodies with 413, both before the body is read.

    Args:
        max_bytes: maximum size by media type, such as `{JSON: 4 * KIB, MSGPACK: AS_SET}`.
        needs_key: False if the route can be called without a key.
    """

    def mark(endpoint: EndpointT) -> EndpointT:
        setattr(endpoint, RULE_ATTRIBUTE, BodyRule(max_bytes, needs_key))
        return endpoint

    return mark


class BodyRules:
    """The rules of all routes of a service."""

    def __init__(self, routers: Sequence[APIRouter], *, max_body_bytes: int) -> None:
        routes = [route for router in routers for route in router.routes]
        self._rules = [
            (
                route.path_regex,
                frozenset(route.methods or ()),
                getattr(route.endpoint, RULE_ATTRIBUTE, DEFAULT_RULE),
            )
            for route in routes
            if isinstance(route, APIRoute)
        ]
        self._max_body_bytes = max_body_bytes

    def rule_of(self, scope: Scope) -> BodyRule:
        """The rule of the route that matches a request."""
        for path_regex, methods, rule in self._rules:
            if scope["method"] in methods and path_regex.match(scope["path"]):
                return rule
        return NO_ROUTE

    def limit(self, headers: Headers, rule: BodyRule) -> int:
        """Maximum size of this request's body.

        Raises:
            HTTPException: 415, a media type that the route does not accept.
        """
        if not rule.max_bytes:
            return self._max_body_bytes
        largest = min(max(rule.max_bytes.values()), self._max_body_bytes)
        if headers.get("content-length", "0") == "0" and "transfer-encoding" not in headers:
            return largest
        got, _ = media_type(headers.get("content-type"))
        if got not in rule.max_bytes:
            raise HTTPException(
                415, f"body: got Content-Type {got!r}, expected {' or '.join(rule.max_bytes)}"
            )
        return min(rule.max_bytes[got], self._max_body_bytes)


def media_type(content_type: str | None) -> tuple[str, dict[str, str]]:
    """A Content-Type's media type and parameters in lower case; "none" where there is none.

    Extended parameters (`name*=charset'language'value`) are ignored.
    """
    header = Message()
    header["content-type"] = content_type or "none/none"
    parameters = {
        name.lower(): value.lower()
        for name, value in header.get_params() or []
        if isinstance(value, str)
    }
    return (header.get_content_type() if content_type else "none"), parameters


class BodyLimit:
    """Wraps `receive` to enforce the limit, with or without Content-Length."""

    def __init__(self, receive: Receive, headers: Headers, max_bytes: int) -> None:
        self._receive = receive
        self._max_bytes = max_bytes
        self._received = 0
        announced = headers.get("content-length", "0")
        self._check(int(announced) if announced.isdecimal() else 0)

    async def __call__(self) -> AsgiMessage:
        """The next message of the request."""
        message = await self._receive()
        self._received += len(message.get("body", b""))
        self._check(self._received)
        return message

    def _check(self, num_bytes: int) -> None:
        if num_bytes > self._max_bytes:
            # Starlette's own class, since FastAPI turns any other into a 400.
            raise HTTPException(
                413, f"body: got {num_bytes} bytes, expected at most {self._max_bytes}"
            )
