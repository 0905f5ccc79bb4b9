"""HTML pages: the screens, signing in and out by a session, and refusals."""

import json
import secrets
import time
from asyncio import to_thread
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, urlencode

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment, FileSystemLoader
from starlette.requests import HTTPConnection

from dextouch.errors import AccessDeniedError, NotFoundError
from dextouch.serving import FORM, KIB, AccessControl, Grant, not_signed_in, takes
from services.dashboard.documents import HELP, Documents, TaskChoice, find_documents, load_tasks
from services.dashboard.settings import DashboardSettings

COOKIE = "dextouch_session"
SCOPE = "operate"
MAX_SESSIONS = 1000
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
PAGE_HEADERS = {
    "content-security-policy": CONTENT_SECURITY_POLICY,
    "x-content-type-options": "nosniff",
    # With "no-referrer", browsers send the sign-in with "Origin: null", which is refused.
    "referrer-policy": "same-origin",
    "cache-control": "no-store",
}
# Jinja2 escapes all values; no HTML is built from strings elsewhere.
TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True
)


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
    Screen(
        "/episodes/{kind}/{item_id}",
        "player.html",
        "Player",
        within="Episodes",
        help="playing-an-episode",
    ),
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


class Sessions:
    """Access of browsers: open on loopback without keys, otherwise by signing in."""

    def __init__(
        self,
        access: AccessControl,
        *,
        needs_key: bool,
        lifetime_s: float,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.needs_key = needs_key
        self.lifetime_s = lifetime_s
        self._access = access
        self._clock_s = clock_s
        # What its key allows and the end of the session, by its token.
        self._open: dict[str, tuple[Grant, float]] = {}

    @property
    def num_open(self) -> int:
        """Sessions that have not ended."""
        now_s = self._clock_s()
        return sum(end_s > now_s for _, end_s in tuple(self._open.values()))

    def sign_in(self, key: str) -> str:
        """Open a session with a key of scope `operate` and return its token.

        Raises:
            AccessDeniedError: an unknown key or one without the scope.
        """
        grant = self._access.granted(f"Bearer {key}", SCOPE)
        now_s = self._clock_s()
        self._open = {token: one for token, one in self._open.items() if one[1] > now_s}
        while len(self._open) >= MAX_SESSIONS:
            self._open.pop(next(iter(self._open)))
        token = secrets.token_urlsafe(32)
        self._open[token] = grant, now_s + self.lifetime_s
        return token

    def sign_out(self, connection: HTTPConnection) -> None:
        """End the session of this browser and invalidate its cookie."""
        self._open.pop(connection.cookies.get(COOKIE, ""), None)

    def allows(self, connection: HTTPConnection) -> bool:
        """Whether a request or WebSocket belongs to an open session."""
        if not self.needs_key:
            return True
        return self.person(connection) is not None

    def person(self, connection: HTTPConnection) -> str | None:
        """Name of the key that opened the session of this browser; None without a session."""
        return self.person_of(connection.cookies.get(COOKIE, ""))

    def person_of(self, token: str) -> str | None:
        """Name of the key that opened a session; None if it is not open."""
        grant = self._grant(token)
        return None if grant is None else grant.name

    def _grant(self, token: str) -> Grant | None:
        grant, end_s = self._open.get(token, (None, 0.0))
        return grant if end_s > self._clock_s() else None

    def guard(self, connection: HTTPConnection) -> None:
        """Refuse browsers that are not signed in."""
        if not self.allows(connection):
            raise not_signed_in()

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
    @takes({FORM: 4 * KIB}, needs_key=False)
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
        request.state.person = sessions.person_of(token)
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
    @takes({FORM: KIB}, needs_key=False)
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
        document = None
        if screen.title == "Help":
            document = await to_thread(documents.read, request.path_params["name"])
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
    return HTMLResponse(text, code, headers=PAGE_HEADERS)
