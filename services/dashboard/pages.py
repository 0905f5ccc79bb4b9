"""HTML pages: the screens, the documents of this release, signing in and out, and refusals."""

import json
import posixpath
import re
import secrets
import sysconfig
import time
import tomllib
from asyncio import to_thread
from collections.abc import Awaitable, Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Final
from urllib.parse import parse_qs, urlencode, urlsplit

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment, FileSystemLoader
from markdown_it import MarkdownIt
from markdown_it.token import Token
from markupsafe import Markup
from pydantic import Field, ValidationError
from starlette.requests import HTTPConnection

from dextouch import serving
from dextouch.errors import AccessDeniedError, InvalidInputError, NotFoundError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems
from services.dashboard.settings import DashboardSettings
from services.dashboard.upstream import SCOPE

COOKIE = "dextouch_session"
MAX_SESSIONS = 1000
# Jinja2 escapes all values; no HTML is built from strings elsewhere.
TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True
)
HELP = "/help/"
PLAYER = "/episodes/{kind}/{item_id}"
# Tasks that the recorder offers by default: those of the twin.
DEFAULT_TASKS: Final = Path(__file__).with_name("tasks.toml")


class Documents:
    """Markdown files of a folder; HTML in them is shown as text."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._markdown = MarkdownIt("commonmark", {"html": False}).enable("table")

    @cached_property
    def _paths(self) -> dict[str, Path]:
        found = sorted(self._folder.rglob("*.md"))
        return {path.relative_to(self._folder).with_suffix("").as_posix(): path for path in found}

    @cached_property
    def titles(self) -> dict[str, str]:
        """First headings of the documents at the top of the folder, by name."""
        return {name: _title(path) for name, path in self._paths.items() if "/" not in name}

    def read(self, name: str) -> Markup:
        """HTML of a document by its name, which is its path without `.md`.

        Raises:
            NotFoundError: no such document, or none is installed.
        """
        if name not in self._paths:
            known = ", ".join(self.titles) or f"none is installed in {self._folder}"
            raise NotFoundError(f"document {name!r}: not one of this release ({known})")
        tokens = self._markdown.parse(self._paths[name].read_text(encoding="utf-8"))
        for token, following in zip(tokens, [*tokens[1:], None], strict=True):
            if token.type == "heading_open" and following is not None:
                # By the rules of common hosts of Markdown.
                words = re.sub(r"[^\w\- ]", "", following.content.lower()).strip()
                token.attrSet("id", words.replace(" ", "-"))
            for part in token.children or ():
                self._link(part, posixpath.dirname(name))
        html = self._markdown.renderer.render(tokens, self._markdown.options, {})
        return Markup(html)  # noqa: S704 - HTML is off in the parser

    def _link(self, part: Token, folder: str) -> None:
        """Lead links between documents to their pages; those to other files of a checkout go."""
        if part.type == "image":
            # Pictures are not served; their description stays.
            part.type, part.tag = "text", ""
            return
        if part.type != "link_open":
            return
        target = urlsplit(str(part.attrGet("href")))
        name = posixpath.normpath(posixpath.join(folder, target.path)).removesuffix(".md")
        if target.scheme:
            part.attrSet("rel", "noreferrer")
        elif target.path and name not in self._paths:
            del part.attrs["href"]
        elif target.path:
            part.attrSet("href", f"{HELP}{name}" + (f"#{target.fragment}" * bool(target.fragment)))


def _title(path: Path) -> str:
    found = re.search(r"^# (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return found[1] if found else path.stem


class TaskChoice(FrozenModel):
    """A task of the list; `goal` and `reset_s` are used in place of those of the settings."""

    name: FreeText = Field(min_length=1, max_length=128)
    instructions: tuple[Annotated[FreeText, Field(min_length=1, max_length=2000)], ...] = Field(
        min_length=1
    )
    goal: int | None = Field(default=None, ge=0, le=1_000_000)
    reset_s: float | None = Field(default=None, ge=0, le=3600)


class _TaskFile(FrozenModel):
    tasks: tuple[TaskChoice, ...] = Field(min_length=1, max_length=1000)


def load_tasks(path: Path | None) -> tuple[TaskChoice, ...]:
    """Tasks of a file; by default those of the twin.

    Raises:
        InvalidInputError: the file cannot be read, is not TOML or has other fields.
    """
    path = path or DEFAULT_TASKS
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return _TaskFile.model_validate(tables).tasks
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"task file {path}: cannot be read: {error}") from error
    except ValidationError as error:
        raise InvalidInputError(
            f"task file {path}: {first_problems(error)}; expected tables [[tasks]] with name, "
            "instructions and optionally goal and reset_s"
        ) from error


@dataclass(frozen=True)
class Screen:
    """A page of the dashboard: where it is, its template, and its name in the navigation.

    Screens that belong to another one, such as the player, have that one's name in `within`; the
    wall is offered to dashboards of several stations. `help` is the section of docs/dashboard.md.
    """

    path: str
    template: str
    title: str
    within: str = ""
    help: str = ""
    of_several: bool = False


SCREENS: Final = (
    Screen("/", "station.html", "Station", help="recording"),
    Screen("/fleet", "fleet.html", "Fleet", help="several-stations", of_several=True),
    Screen("/health", "health.html", "Health", help="health"),
    Screen("/episodes", "episodes.html", "Episodes", help="recordings-and-episodes"),
    Screen(PLAYER, "player.html", "Player", within="Episodes", help="playing-an-episode"),
    Screen("/objects", "objects.html", "Mark objects", within="Episodes", help="mark-objects"),
    Screen("/review", "review.html", "Review", help="review"),
    Screen("/hours", "hours.html", "Hours", help="hours"),
    Screen("/calibration", "calibration.html", "Calibration", help="calibration"),
    Screen("/rollouts", "rollouts.html", "Rollouts", help="rollouts"),
    Screen("/studies", "studies.html", "Studies", help="studies"),
    Screen("/studies/{name}", "study.html", "Study", within="Studies", help="studies"),
    Screen("/system", "system.html", "System", help="system"),
    Screen(f"{HELP}{{name:path}}", "help.html", "Help", within="Help"),
)


@dataclass(eq=False)
class Sessions:
    """Access of browsers: open on loopback without keys, otherwise by signing in."""

    # Of the application, which is made later.
    access: serving.AccessControl = field(init=False)
    _: KW_ONLY
    needs_key: bool
    lifetime_s: float
    clock_s: Callable[[], float] = time.monotonic
    # The digest of its key and the end of the session, by its token.
    _open: dict[str, tuple[bytes, float]] = field(default_factory=dict)

    @property
    def num_open(self) -> int:
        """Sessions that have not ended."""
        now_s = self.clock_s()
        return sum(end_s > now_s for _, end_s in tuple(self._open.values()))

    def sign_in(self, key: str) -> str:
        """Open a session with a key of scope `operate` and return its token.

        Raises:
            AccessDeniedError: an unknown key or one without the scope.
        """
        self.access.check(f"Bearer {key}", SCOPE)
        now_s = self.clock_s()
        self._open = {token: one for token, one in self._open.items() if one[1] > now_s}
        while len(self._open) >= MAX_SESSIONS:
            self._open.pop(next(iter(self._open)))
        token = secrets.token_urlsafe(32)
        self._open[token] = serving.secret_digest(key.strip()), now_s + self.lifetime_s
        return token

    def sign_out(self, connection: HTTPConnection) -> None:
        """End the session of this browser and invalidate its cookie."""
        self._open.pop(connection.cookies.get(COOKIE, ""), None)

    def allows(self, connection: HTTPConnection) -> bool:
        """Whether a request or WebSocket belongs to an open session."""
        return not self.needs_key or self.person(connection) is not None

    def person(self, connection: HTTPConnection) -> str | None:
        """Name of the key that opened the session of this browser; None without a session."""
        return self.person_of(connection.cookies.get(COOKIE, ""))

    def person_of(self, token: str) -> str | None:
        """Name of the key that opened a session; None if it is not open."""
        grant = self._grant(token)
        return None if grant is None else grant.name

    def _grant(self, token: str) -> serving.Grant | None:
        digest, end_s = self._open.get(token, (b"", 0.0))
        # A key that the settings no longer have takes its sessions along.
        return self.access.of_digest(digest) if end_s > self.clock_s() else None

    def guard(self, connection: HTTPConnection) -> None:
        """Refuse browsers that are not signed in."""
        if not self.allows(connection):
            raise serving.not_signed_in()

    def require(self, connection: HTTPConnection, scope: str) -> None:
        """Refuse browsers that signed in with a key without this scope."""
        self.guard(connection)
        grant = self._grant(connection.cookies.get(COOKIE, ""))
        if grant is not None:
            grant.require(scope)


def page_router(settings: DashboardSettings, sessions: Sessions) -> APIRouter:
    """Router of the HTML pages."""
    router = APIRouter(include_in_schema=False)
    page = partial(_page, settings.station)
    tasks = load_tasks(settings.task_file)
    documents = Documents(find_documents())
    for screen in SCREENS:
        show = _shown(screen, settings, sessions, tasks, documents)
        router.add_api_route(screen.path, show, methods=["GET"])

    @router.post("/sign_in")
    @serving.takes({serving.FORM: 4 * serving.KIB}, needs_key=False)
    async def sign_in(request: Request) -> Response:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"))
        wanted = _own_path(fields.get("wanted", ["/"])[0])
        try:
            token = sessions.sign_in(fields.get("key", [""])[0])
        except AccessDeniedError as refused:
            error = _counted(request, refused)
            too_many = error is not refused
            status = 429 if too_many else 401
            request.app.state.refusals.note(request, status, str(error.details["reason"]))
            answer = page("sign_in.html", status, reason=error.message, wanted=wanted)
            if too_many:
                answer.headers["retry-after"] = str(error.details["retry_after_s"])
            return answer
        # Without keys there is nobody to name.
        request.state.person = sessions.person_of(token) or ""
        entered = RedirectResponse(wanted, 303)
        entered.set_cookie(
            COOKIE,
            token,
            max_age=int(sessions.lifetime_s),
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
        )
        return entered

    @router.post("/sign_out")
    @serving.takes({serving.FORM: serving.KIB}, needs_key=False)
    async def sign_out(request: Request) -> Response:
        sessions.sign_out(request)
        answer = RedirectResponse("/", 303)
        answer.delete_cookie(COOKIE)
        return answer

    return router


def _counted(request: Request, error: AccessDeniedError) -> AccessDeniedError:
    """The refusal of a sign-in: that of many wrong keys in place of that of one."""
    if error.details["reason"] == "unknown_key":
        try:
            request.app.state.wrong_keys.count(request)
        except AccessDeniedError as too_many:
            return too_many
    return error


def _shown(
    screen: Screen,
    settings: DashboardSettings,
    sessions: Sessions,
    tasks: tuple[TaskChoice, ...],
    documents: Documents,
) -> Callable[[Request], Awaitable[Response]]:
    """Route of a screen; browsers that are not signed in get the sign-in in its place."""

    async def show(request: Request) -> Response:
        if not sessions.allows(request):
            wanted = _own_path(f"{request.url.path}?{request.url.query}".rstrip("?"))
            return _page(settings.station, "sign_in.html", reason="", wanted=wanted)
        names, chosen = list(settings.station_urls()), request.query_params.get("station")
        if chosen is not None and chosen not in names:
            raise NotFoundError(f"station {chosen!r}: this dashboard shows {', '.join(names)}")
        document: dict[str, object] = {}
        if screen.title == "Help":
            name = request.path_params["name"]
            document = {"name": name, "html": await to_thread(documents.read, name)}
            document["titles"] = await to_thread(getattr, documents, "titles")
        return _page(
            chosen or (names[0] if names else settings.station),
            screen.template,
            screen=screen,
            screens=[
                one for one in SCREENS if not one.within and (len(names) > 1 or not one.of_several)
            ],
            query=f"?{urlencode({'station': chosen})}" if chosen else "",
            tasks=tasks,
            settings=settings,
            goals=json.dumps(settings.goal_hours),
            signed_in=sessions.needs_key,
            person=sessions.person(request) or "",
            document=document,
        )

    return show


def _own_path(text: str) -> str:
    """A path of this site to go to after signing in; "/" in place of anything else."""
    is_own = text.startswith("/") and text.isascii() and text.isprintable()
    return text if is_own and not text.startswith(("//", "/\\")) else "/"


def refusal_page(station: str, reason: str, status: int) -> Response:
    """HTML page of a refusal, in place of problem+json."""
    return _page(station, "refused.html", status, status=status, reason=reason)


def _page(station: str, name: str, code: int = 200, **values: object) -> HTMLResponse:
    text = TEMPLATES.get_template(name).render(station=station, **values)
    return HTMLResponse(text, code, headers=serving.page_headers(forms="'self'"))


def find_documents() -> Path:
    """The folder `docs` of this repository, or of the installed package."""
    here = Path(__file__).parents[2] / "docs"
    return here if here.is_dir() else Path(sysconfig.get_path("data")) / "share/dextouch/docs"
