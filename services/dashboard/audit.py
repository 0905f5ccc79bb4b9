"""Audit log of the dashboard: who changed what and when, as JSON lines in files that rotate."""

import heapq
import json
import os
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs

import structlog
from pydantic import AwareDatetime, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.requests import HTTPConnection
from starlette.routing import compile_path
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dextouch.episodes import sync_folder, write_parts
from dextouch.errors import DexTouchError, InvalidInputError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import StationEnrolments
from dextouch.serving import masked
from services.dashboard.feeds import ACTIONS as RECORDER_ACTIONS
from services.dashboard.pages import Sessions
from services.dashboard.upstream import FORWARDED, Upstream

logger = structlog.get_logger(__name__)

MAX_IN_MEMORY: Final = 1000
# Of the newest file and the older ones; the oldest is deleted when a new one begins.
NUM_FILES: Final = 8
NOT_SIGNED_IN: Final = "not signed in"
SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
MAX_BODY_BYTES: Final = 256 * 1024
MAX_NAME: Final = 128
MAX_TARGET: Final = 4000
OPEN_ACCESS: Final = "open access"
ENROLMENT: Final = "use enrolment token"
# What each route of the dashboard does; tests check that none is missing.
ACTIONS: Final[Mapping[str, str]] = {
    "/sign_in": "sign in",
    "/sign_out": "sign out",
    "/v1/recorder/{action}": "recorder",
    "/v1/uploads/{recording_id}/retry": "send upload again",
    "/v1/comparisons": "start replay",
    "/v1/comparisons/stop": "stop replay",
    # Several a second; that they began is noted.
    "/v1/comparisons/{comparison_id}/moves": "",
    **{f"/v1/{one.service}{one.path}": one.action for one in FORWARDED if one.action},
}
OF_STATION: Final = ("/v1/recorder/", "/v1/uploads/")
# Fields of bodies that name what is changed, or how; all others may be private.
NAMED: Final = ("station", "verdict", "kind", "subject", "task", "recording_id", "episode_id")
ALL_ACTIONS: Final = tuple(
    sorted(
        [
            *set(ACTIONS.values()) - {"recorder", ""},
            ENROLMENT,
            *(f"recorder: {action}" for action in RECORDER_ACTIONS),
        ]
    )
)
_ROUTES: Final = [(compile_path(path)[0], path, action) for path, action in ACTIONS.items()]


class AuditEntry(FrozenModel):
    """One request that changes something.

    `person` is the name of the key that signed in, "open access" where no key is needed, or "not
    signed in". `status` is that of the HTTP response, `request_id` that of the logs.
    """

    at: AwareDatetime
    person: str
    action: str
    target: str = ""
    status: int
    client: str = ""
    request_id: str = ""


class AuditPage(FrozenModel):
    """The newest entries, newest first.

    `people` are those whose entries were read on the way, `folder` is None for a log in memory
    alone, `num_damaged` counts unreadable lines among those read, `num_lost` entries that could not
    be written since the start; `no_used_tokens` says why entries of enrolled stations are missing.
    """

    entries: tuple[AuditEntry, ...]
    has_more: bool
    actions: tuple[str, ...] = ()
    people: tuple[str, ...]
    folder: str | None
    num_damaged: int
    num_lost: int
    no_used_tokens: str = ""


class RotatedLines:
    """Lines in numbered files of a folder, `max_bytes` together, of which old ones are deleted.

    With `sync` a line survives a power loss, not only the end of the process.
    """

    def __init__(self, folder: Path, name: str, *, max_bytes: int, sync: bool) -> None:
        self._folder, self._name, self._sync = folder, name, sync
        self._max_file_bytes = max_bytes // NUM_FILES

    def _paths(self) -> list[Path]:
        """Oldest first."""
        return sorted(self._folder.glob(f"{self._name}-" + "[0-9]" * 9 + ".jsonl"))

    def append(self, line: bytes) -> None:
        """Add a line, after the rest of one that could not be finished; raises OSError."""
        paths = self._paths()
        path = paths[-1] if paths else self._path(1)
        if paths and path.stat().st_size + len(line) > self._max_file_bytes:
            path = self._path(int(path.stem[-9:]) + 1)
            for old in paths[: max(0, len(paths) + 1 - NUM_FILES)]:
                old.unlink(missing_ok=True)
        is_new = not path.exists()
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o640)
        try:
            size = os.fstat(descriptor).st_size
            is_torn = size > 0 and os.pread(descriptor, 1, size - 1) != b"\n"
            write_parts(descriptor, b"\n" if is_torn else b"", line, b"\n")
            if self._sync:
                os.fsync(descriptor)
        finally:
            os.close(descriptor)
        if is_new and self._sync:
            sync_folder(self._folder)

    def _path(self, number: int) -> Path:
        return self._folder / f"{self._name}-{number:09}.jsonl"

    def newest_first(self) -> Iterator[bytes]:
        """All lines, also damaged ones."""
        for path in reversed(self._paths()):
            try:
                content = path.read_bytes()
            except FileNotFoundError:
                continue  # just rotated away
            yield from (line for line in reversed(content.split(b"\n")) if line)


class AuditLog:
    """Entries of the requests that change something, in a folder or in memory; thread-safe.

    Those without a session rotate in files of their own, so that they cannot displace the others.
    """

    def __init__(self, folder: Path | None, *, max_bytes: int) -> None:
        self.folder = folder
        self.num_lost = 0
        self._lock = threading.Lock()
        self._in_memory: deque[AuditEntry] = deque(maxlen=MAX_IN_MEMORY)
        self._of_people: RotatedLines | None = None
        self._of_others: RotatedLines | None = None
        if folder is not None:
            _prepare(folder)
            half = max_bytes // 2
            self._of_people = RotatedLines(folder, "audit", max_bytes=half, sync=True)
            self._of_others = RotatedLines(folder, "not_signed_in", max_bytes=half, sync=False)

    def write(self, entry: AuditEntry) -> None:
        """Keep an entry; if the disk refuses it, it is counted, logged and kept in memory."""
        files = self._of_others if entry.person == NOT_SIGNED_IN else self._of_people
        with self._lock:
            try:
                if files is None:
                    self._in_memory.append(entry)
                else:
                    # Escapes make it one line of ASCII, whatever the texts hold.
                    files.append(entry.model_dump_json(ensure_ascii=True).encode())
            except OSError:
                self.num_lost += 1
                self._in_memory.append(entry)
                logger.exception("audit_not_written", entry=entry.model_dump(mode="json"))

    def newest(
        self,
        limit: int,
        *,
        action: str | None = None,
        person: str | None = None,
        others: Iterable[AuditEntry] = (),
    ) -> AuditPage:
        """The newest entries, those of an action and of a person only if these are given.

        `others` are entries that are kept elsewhere.
        """
        damaged = 0

        def readable(lines: RotatedLines | None) -> Iterator[AuditEntry]:
            nonlocal damaged
            for line in () if lines is None else lines.newest_first():
                try:
                    yield AuditEntry.model_validate_json(line)
                except ValidationError:
                    damaged += 1

        with self._lock:
            remembered = list(reversed(self._in_memory))
        elsewhere = sorted(others, key=lambda one: one.at, reverse=True)
        logged = (readable(self._of_people), readable(self._of_others))
        sources = (*logged, iter(remembered), iter(elsewhere))
        found: list[AuditEntry] = []
        people: dict[str, None] = {}
        for entry in heapq.merge(*sources, key=lambda one: one.at, reverse=True):
            people[entry.person] = None
            if action in (None, entry.action) and person in (None, entry.person):
                found.append(entry)
                if len(found) > limit:
                    break
        return AuditPage(
            entries=tuple(found[:limit]),
            has_more=len(found) > limit,
            people=tuple(sorted(people)),
            folder=None if self.folder is None else str(self.folder),
            num_damaged=damaged,
            num_lost=self.num_lost,
        )


def _prepare(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK | os.X_OK)
    except OSError as error:
        raise InvalidInputError(f"audit_folder {folder}: cannot be created ({error})") from error
    if not writable:
        raise InvalidInputError(
            f"audit_folder {folder}: cannot be written by this user; choose another folder, or "
            "none to keep the audit log in memory only"
        )


class AuditTrail:
    """Middleware that writes an entry before the response to a request begins.

    Of a request it keeps names of items and actions, never its body, query or headers.
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
        person = OPEN_ACCESS
        if self._sessions.needs_key:
            person = self._sessions.person(HTTPConnection(scope)) or NOT_SIGNED_IN

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

    def _place(self, scope: Scope, path: str) -> list[str]:
        if not path.startswith(OF_STATION):
            return []
        named = parse_qs(scope["query_string"].decode("latin-1")).get("station", [self._station])
        return [named[0]]


def _known(scope: Scope) -> tuple[str, str, list[str]] | None:
    """Route, action and names in the path of a request that changes something."""
    if scope["method"] in SAFE_METHODS:
        return None
    for pattern, path, action in _ROUTES:
        if action and (match := pattern.match(scope["path"])):
            names = match.groupdict()
            verb = names.pop("action", None)
            named = action if verb is None else f"{action}: {_clean(verb)}"
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


async def used_tokens(store: Upstream | None) -> tuple[list[AuditEntry], str]:
    """Entries of all used tokens, and why they are missing if the store does not list them."""
    if store is None:
        return [], ""
    try:
        listed = await store.read(StationEnrolments, "/v1/enrolments")
    except DexTouchError as error:
        return [], error.message
    entries = [
        AuditEntry(
            at=one.enrolled_at,
            person=f"station {one.station}",
            action=ENROLMENT,
            target=one.station,
            status=HTTPStatus.CREATED,
            client=one.enrolled_from,
        )
        for one in listed.enrolments
        if one.enrolled_at is not None
    ]
    return entries, ""
