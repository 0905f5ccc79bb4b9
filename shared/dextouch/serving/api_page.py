"""Page of a service's OpenAPI document at /docs, which needs no other host: Swagger UI."""

from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Final

from fastapi import APIRouter, Request, Response
from starlette.staticfiles import StaticFiles

FOLDER: Final = Path(__file__).parent / "static"
FILES: Final = {
    "/docs": "index.html",
    "/docs/page.js": "page.js",
    "/docs/swagger-ui.css": "vendor/swagger-ui.css",
    "/docs/swagger-ui-bundle.js": "vendor/swagger-ui-bundle.js",
}


def page_headers(
    *, images: str = "'self'", forms: str = "'none'", cache: str = "no-store"
) -> dict[str, str]:
    """Headers of a page that loads only files of its service; arguments are sources of the policy.

    `cache` is its Cache-Control.
    """
    return {
        "content-security-policy": (
            f"default-src 'none'; script-src 'self'; style-src 'self'; img-src {images}; "
            f"connect-src 'self'; form-action {forms}; frame-ancestors 'none'; base-uri 'none'"
        ),
        "x-content-type-options": "nosniff",
        # With "no-referrer", browsers send a sign-in with "Origin: null", which is refused.
        "referrer-policy": "same-origin",
        "cache-control": cache,
    }


def api_page_router() -> APIRouter:
    """Router of the page and its files, which need no key, as the document itself."""
    # The style sheet of Swagger UI contains pictures.
    return file_router(FOLDER, FILES, page_headers(images="'self' data:", cache="no-cache"))


def file_router(folder: Path, files: Mapping[str, str], headers: Mapping[str, str]) -> APIRouter:
    """Router of a page's files, by address, which need no key."""
    router = APIRouter(include_in_schema=False)
    static = StaticFiles(directory=folder)
    for address, name in files.items():
        router.add_api_route(address, _answer(static, name, headers), methods=["GET", "HEAD"])
    return router


def _answer(
    static: StaticFiles, name: str, headers: Mapping[str, str]
) -> Callable[[Request], Awaitable[Response]]:
    # FastAPI would take any further argument, even one with a default, from the query.
    async def file(request: Request) -> Response:
        answer = await static.get_response(name, request.scope)
        answer.headers.update(headers)
        return answer

    return file
