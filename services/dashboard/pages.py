"""HTML pages: the station, signing in and out, and refusals."""

from functools import partial
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


def page_router(settings: DashboardSettings, sessions: Sessions) -> APIRouter:
    """Router of the HTML pages."""
    router = APIRouter(include_in_schema=False)
    page = partial(_page, settings.station)

    @router.get("/")
    async def index(request: Request) -> Response:
        if not sessions.allows(request):
            return page("sign_in.html", reason="")
        return page("index.html", tasks=settings.tasks, signed_in=sessions.needs_key)

    @router.post("/sign_in")
    @takes({FORM: 4 * KIB}, needs_key=False)
    async def sign_in(request: Request) -> Response:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"))
        try:
            token = sessions.sign_in(fields.get("key", [""])[0])
        except AccessDeniedError as error:
            return page("sign_in.html", 401, reason=error.message)
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
        sessions.sign_out(request)
        answer = RedirectResponse("/", 303)
        answer.delete_cookie(COOKIE)
        return answer

    return router


def refusal_page(station: str, _: Request, error: DexTouchError) -> Response:
    """HTML page of a refusal, in place of problem+json."""
    return _page(station, "refused.html", status_of(error), reason=error.message)


def _page(station: str, name: str, status: int = 200, **values: object) -> HTMLResponse:
    text = TEMPLATES.get_template(name).render(station=station, **values)
    return HTMLResponse(text, status, headers=PAGE_HEADERS)
