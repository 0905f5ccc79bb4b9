"""Page of a service's OpenAPI document at /docs, which needs no other host: Swagger UI."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from fastapi import APIRouter
from fastapi.responses import FileResponse

FOLDER: Final = Path(__file__).parent / "static"
FILES: Final = {
    "/docs": "index.html",
    "/docs/page.js": "page.js",
    "/docs/swagger-ui.css": "vendor/swagger-ui.css",
    "/docs/swagger-ui-bundle.js": "vendor/swagger-ui-bundle.js",
}
HEADERS: Final = {
    # As of the other pages, and the pictures in the style sheet of Swagger UI.
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
        "connect-src 'self'; form-action 'none'; frame-ancestors 'none'; base-uri 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cache-control": "no-cache",
}


def api_page_router() -> APIRouter:
    """Router of the page and its files, which need no key, as the document itself."""
    return file_router(FOLDER, FILES, HEADERS)


def file_router(folder: Path, files: Mapping[str, str], headers: Mapping[str, str]) -> APIRouter:
    """Router of a page's files, by address, which need no key."""
    router = APIRouter(include_in_schema=False)
    for address, name in files.items():

        async def file(name: str = name) -> FileResponse:
            return FileResponse(folder / name, headers=headers)

        router.add_api_route(address, file)
    return router
