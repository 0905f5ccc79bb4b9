"""Routes of other services that the pages call, forwarded by an allow-list."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final, Literal
from urllib.parse import quote

from fastapi import APIRouter, Depends, Request, Response
from starlette.datastructures import QueryParams

from dextouch.serving import JSON, KIB, takes
from services.dashboard.fleet import Fleet
from services.dashboard.pages import SCOPE, Sessions

# Headers of a response that a browser needs to show and to cache it.
PASSED_HEADERS: Final = ("content-type", "etag", "cache-control", "location")
# What a user asked for may take longer to compute than the state that pages fetch again and again.
TIMEOUT_S: Final = 60.0
# Of administrators, who have it beside that of operators.
ENROL: Final = "enrol"


@dataclass(frozen=True)
class Forwarded:
    """A route of a service, `path` below its /v1, offered as /v1/SERVICE/PATH.

    The key that signed in needs `scope`.
    """

    service: str
    path: str
    method: Literal["GET", "POST", "DELETE"] = "GET"
    max_body_bytes: int = 64 * KIB
    scope: str = SCOPE


FORWARDED: Final = (
    Forwarded("acquisition", "/health"),
    Forwarded("acquisition", "/health/events"),
    Forwarded("acquisition", "/health/history"),
    Forwarded("episode_store", "/episodes"),
    Forwarded("episode_store", "/episodes/{item_id}"),
    Forwarded("episode_store", "/recordings"),
    Forwarded("episode_store", "/recordings/{item_id}/attributes"),
    Forwarded("episode_store", "/catalog/items"),
    Forwarded("episode_store", "/catalog/groups"),
    Forwarded("episode_store", "/catalog/reviews", "POST", max_body_bytes=256 * KIB),
    Forwarded("episode_store", "/catalog/clicks"),
    Forwarded("episode_store", "/catalog/clicks/file"),
    Forwarded("episode_store", "/episodes/{item_id}/clicks"),
    Forwarded("episode_store", "/episodes/{item_id}/clicks", "POST", max_body_bytes=16 * KIB),
    Forwarded("episode_store", "/catalog/hours"),
    Forwarded("episode_store", "/catalog/hours/{field}"),
    Forwarded("episode_store", "/catalog/values"),
    Forwarded("episode_store", "/catalog/lineage/{kind}/{item_id}"),
    Forwarded("episode_store", "/playback/{kind}/{item_id}"),
    Forwarded("episode_store", "/playback/{kind}/{item_id}/images/{camera}"),
    Forwarded("episode_store", "/playback/{kind}/{item_id}/signals"),
    Forwarded("episode_store", "/playback/episode/{item_id}/robot_hands"),
    Forwarded("episode_store", "/episodes/{item_id}/streams/{stream}"),
    Forwarded("episode_store", "/recordings/{item_id}/streams/{stream}"),
    Forwarded("episode_store", "/trash"),
    Forwarded("episode_store", "/trash", "POST", max_body_bytes=256 * KIB),
    Forwarded("episode_store", "/trash/restore", "POST", max_body_bytes=256 * KIB),
    Forwarded("episode_store", "/uploads"),
    Forwarded("episode_store", "/enrolments"),
    Forwarded("episode_store", "/enrolments", "POST", scope=ENROL),
    Forwarded("episode_store", "/enrolments/{station}/revoke", "POST", scope=ENROL),
    Forwarded("acquisition", "/uploads"),
    Forwarded("alignment", "/alignments"),
    Forwarded("alignment", "/alignments", "POST"),
    Forwarded("alignment", "/alignments/{alignment_id}"),
    Forwarded("alignment", "/alignments/{alignment_id}/cancel", "POST"),
    Forwarded("alignment", "/calibration"),
    Forwarded("alignment", "/calibration/run"),
    Forwarded("alignment", "/calibration/run/image"),
    Forwarded("alignment", "/calibration/runs", "POST"),
    Forwarded("alignment", "/calibration/run/answer", "POST"),
    Forwarded("alignment", "/calibration/run/finish", "POST"),
    Forwarded("alignment", "/calibration/run/cancel", "POST"),
    Forwarded("studies", "/studies"),
    Forwarded("studies", "/studies/{name}"),
    Forwarded("studies", "/studies/{name}/rollouts"),
)


def forwarding_router(fleet: Fleet, sessions: Sessions) -> APIRouter:
    """Create the forwarded routes; the services' own documents describe their bodies."""
    router = APIRouter(
        prefix="/v1", dependencies=[Depends(sessions.guard)], include_in_schema=False
    )
    for route in FORWARDED:
        router.add_api_route(
            f"/{route.service}{route.path}",
            _forwarder(fleet, route, sessions),
            methods=[route.method],
            response_class=Response,
        )
    return router


def _forwarder(
    fleet: Fleet, route: Forwarded, sessions: Sessions
) -> Callable[[Request], Awaitable[Response]]:
    async def forward(request: Request) -> Response:
        sessions.require(request, route.scope)
        names = {name: quote(value, safe="") for name, value in request.path_params.items()}
        path = f"/v1{route.path}".format(**names)
        query, feeds = request.query_params, fleet.of()
        if route.service == "acquisition":
            feeds = fleet.of(query.get("station"))
            query = QueryParams(
                [(key, value) for key, value in query.multi_items() if key != "station"]
            )
        if query:
            path += f"?{query}"
        sent = {
            name: request.headers[name] for name in ("if-none-match",) if name in request.headers
        }
        content = await request.body() if route.method == "POST" else b""
        if content:
            sent["content-type"] = JSON
        answer = await feeds.upstream(route.service).forward(
            route.method, path, sent, content, timeout_s=TIMEOUT_S
        )
        passed = {name: answer.headers[name] for name in PASSED_HEADERS if name in answer.headers}
        return Response(answer.content, answer.status_code, headers=passed)

    return takes({JSON: route.max_body_bytes})(forward) if route.method == "POST" else forward
