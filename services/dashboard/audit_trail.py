"""ASGI middleware that writes every request that changes something into the audit log.

Of a request it keeps names of items and actions, never its body, query or headers.
"""

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, Final
from urllib.parse import parse_qs

from starlette.concurrency import run_in_threadpool
from starlette.requests import HTTPConnection
from starlette.routing import compile_path
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dextouch.serving import masked
from services.dashboard.audit import NOT_SIGNED_IN, AuditEntry, AuditLog
from services.dashboard.enrolments import ACTION as USE_TOKEN
from services.dashboard.feeds import ACTIONS as RECORDER_ACTIONS
from services.dashboard.pages import Sessions

SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
MAX_BODY_BYTES: Final = 256 * 1024
MAX_NAME: Final = 128
MAX_TARGET: Final = 4000
OPEN_ACCESS: Final = "open access"
# What each route of the dashboard does; tests check that none is missing.
ACTIONS: Final[Mapping[str, str]] = {
    "/sign_in": "sign in",
    "/sign_out": "sign out",
    "/v1/recorder/{action}": "recorder",
    "/v1/uploads/{recording_id}/retry": "send upload again",
    "/v1/comparisons": "start replay",
    "/v1/comparisons/stop": "stop replay",
    "/v1/episode_store/catalog/reviews": "review",
    "/v1/episode_store/episodes/{item_id}/clicks": "mark objects",
    "/v1/episode_store/trash": "delete",
    "/v1/episode_store/trash/restore": "restore",
    "/v1/episode_store/enrolments": "enrol station",
    "/v1/episode_store/enrolments/{station}/revoke": "revoke station",
    "/v1/alignment/alignments": "align",
    "/v1/alignment/alignments/{alignment_id}/cancel": "cancel alignment",
    "/v1/alignment/calibration/runs": "start calibration",
    "/v1/alignment/calibration/run/answer": "answer calibration",
    "/v1/alignment/calibration/run/finish": "finish calibration",
    "/v1/alignment/calibration/run/cancel": "cancel calibration",
}
OF_STATION: Final = ("/v1/recorder/", "/v1/uploads/")
# Fields of bodies that name what is changed, or how; all others may be private.
NAMED: Final = ("station", "verdict", "kind", "subject", "task", "recording_id", "episode_id")
ALL_ACTIONS: Final = tuple(
    sorted(
        [
            *set(ACTIONS.values()) - {"recorder"},
            USE_TOKEN,
            *(f"recorder: {action}" for action in RECORDER_ACTIONS),
        ]
    )
)
_ROUTES: Final = [(compile_path(path)[0], path, action) for path, action in ACTIONS.items()]


class AuditTrail:
    """Middleware that writes an entry before the response to a request begins.

    Args:
        app: the application.
        log: where entries are kept.
        sessions: who is signed in.
        station: name of the station of requests that name none.
    """

    def __init__(self, app: ASGIApp, *, log: AuditLog, sessions: Sessions, station: str) -> None:
        self._app, self._log, self._sessions, self._station = app, log, sessions, station

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; those that change nothing, and other scopes, pass through."""
        known = _known(scope) if scope["type"] == "http" else None
        if known is None:
            await self._app(scope, receive, send)
            return
        body = bytearray()
        written = False
        person = self._person(scope)

        async def receive_and_keep() -> Message:
            message = await receive()
            if len(body) <= MAX_BODY_BYTES:
                body.extend(message.get("body", b""))
            return message

        async def write(status: int) -> None:
            nonlocal written
            written = True
            path, action, names = known
            targets = [*self._place(scope, path), *names, *_named(path, bytes(body))]
            entry = AuditEntry(
                at=datetime.now(UTC),
                person=scope["state"].get("person", person),
                action=action,
                target=_joined(targets),
                status=status,
                client=(scope.get("client") or ("",))[0],
                request_id=scope["state"].get("request_id", ""),
            )
            await run_in_threadpool(self._log.write, entry)

        async def write_and_send(message: Message) -> None:
            if message["type"] == "http.response.start":
                await write(message["status"])
            await send(message)

        scope.setdefault("state", {})
        try:
            await self._app(scope, receive_and_keep, write_and_send)
        finally:
            if not written:
                await write(500)

    def _person(self, scope: Scope) -> str:
        if not self._sessions.needs_key:
            return OPEN_ACCESS
        return self._sessions.person(HTTPConnection(scope)) or NOT_SIGNED_IN

    def _place(self, scope: Scope, path: str) -> list[str]:
        if not path.startswith(OF_STATION):
            return []
        asked = parse_qs(scope["query_string"].decode("latin-1")).get("station", [self._station])
        return [asked[0]]


def _known(scope: Scope) -> tuple[str, str, list[str]] | None:
    """Route, action and names in the path of a request that changes something."""
    if scope["method"] in SAFE_METHODS:
        return None
    for pattern, path, action in _ROUTES:
        if match := pattern.match(scope["path"]):
            names = match.groupdict()
            asked = names.pop("action", None)
            named = action if asked is None else f"{action}: {_clean(asked)}"
            return path, named, list(names.values())
    return None


def _named(path: str, body: bytes) -> Iterator[str]:
    """Names in the body of a request, which are those of items or fixed words."""
    if path.startswith("/sign") or not 0 < len(body) <= MAX_BODY_BYTES:
        return
    try:
        fields = json.loads(body)
    except (ValueError, RecursionError):
        return
    if isinstance(fields, dict):
        listed = [fields.get(name) for name in NAMED]
        listed += _list(fields.get("recording_ids"))
        items = _list(fields.get("items"))
        listed += [item.get("id") for item in items if isinstance(item, dict)]
        yield from (name for name in listed if isinstance(name, str))


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def _clean(text: str) -> str:
    """A name without secrets of this process and without characters that move others."""
    shown = "".join(
        one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in masked(text)
    )
    return shown if len(shown) <= MAX_NAME else shown[: MAX_NAME - 1] + "…"


def _joined(targets: list[str]) -> str:
    """As many of the names as there is room for, each once."""
    names = list(dict.fromkeys(map(_clean, targets)))
    shown, num_left = "", len(names)
    for name in names:
        if len(shown) + len(name) > MAX_TARGET:
            return f"{shown}, and {num_left} more"
        shown += f", {name}" if shown else name
        num_left -= 1
    return shown
