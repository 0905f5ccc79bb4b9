"""HTML pages: the station, signing in and out, and refusals."""

from pathlib import Path
from urllib.parse import parse_qs

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment, FileSystemLoader

from dextouch.errors import AccessDeniedError, DexTouchError
from dextouch.schemas import status_of
from dextouch.serving import FORM, KIB, takes
from services.dashboard.sessions import COOKIE, Sessions
from services.dashboard.settings import DashboardSettings

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


def page_router() -> APIRouter:
    """Router of the HTML pages."""
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    async def index(request: Request) -> Response:
        sessions: Sessions = request.app.state.sessions
        if not sessions.allows(request):
            return _page(request, "sign_in.html", reason="")
        tasks = request.app.state.settings.tasks
        return _page(request, "index.html", tasks=tasks, signed_in=sessions.needs_key)

    @router.post("/sign_in")
    @takes({FORM: 4 * KIB}, needs_key=False)
    async def sign_in(request: Request) -> Response:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"))
        sessions: Sessions = request.app.state.sessions
        try:
            token = sessions.sign_in(fields.get("key", [""])[0])
        except AccessDeniedError as error:
            return _page(request, "sign_in.html", 401, reason=error.message)
        answer = RedirectResponse("/", 303)
        answer.set_cookie(
            COOKIE,
            token,
            max_age=int(sessions.lifetime_s),
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
        )
        return answer

    @router.post("/sign_out")
    @takes({FORM: KIB}, needs_key=False)
    async def sign_out(request: Request) -> Response:
        sessions: Sessions = request.app.state.sessions
        sessions.sign_out(request)
        answer = RedirectResponse("/", 303)
        answer.delete_cookie(COOKIE)
        return answer

    return router


def refusal_page(request: Request, error: DexTouchError) -> Response:
    """HTML page of a refusal, in place of problem+json."""
    return _page(request, "refused.html", status_of(error), reason=error.message)


def _page(request: Request, name: str, status: int = 200, **values: object) -> HTMLResponse:
    settings: DashboardSettings = request.app.state.settings
    text = TEMPLATES.get_template(name).render(station=settings.station, **values)
    return HTMLResponse(text, status, headers=PAGE_HEADERS)
