"""Routes of the page: its data, live updates, recorder actions, and those of other services."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Annotated, Any, Final

from fastapi import (
    APIRouter,
    Body,
    Depends,
    Path,
    Query,
    Request,
    Response,
    WebSocket,
    WebSocketDisconnect,
)
from fastapi.responses import JSONResponse
from fastapi.security import APIKeyCookie
from pydantic import Field, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import QueryParams

from dextouch.errors import AccessDeniedError, NotFoundError
from dextouch.frozen_model import FrozenModel
from dextouch.serving import JSON, KIB, OCTETS, StreamedResponse, takes
from services.dashboard.audit import ALL_ACTIONS, AuditLog, AuditPage, used_tokens
from services.dashboard.comparison import Comparisons, ComparisonView, StartComparison
from services.dashboard.feeds import (
    Feeds,
    HeatmapLayout,
    OverviewView,
    Topic,
    heatmap_layout,
    skeleton_bones,
)
from services.dashboard.fleet import Fleet
from services.dashboard.hand_driving import Moves
from services.dashboard.pages import COOKIE, Sessions
from services.dashboard.settings import DashboardSettings
from services.dashboard.station_view import RecorderView
from services.dashboard.system import System, SystemView
from services.dashboard.upstream import FORWARDED, Forwarded, Upstream, path_part

WEBSOCKET_REFUSED = 1008
# Interval at which a WebSocket checks that its session is still valid.
SESSION_CHECK_S = 1.0
# Documents the cookie; `Sessions.guard` checks it.
SESSION = APIKeyCookie(name=COOKIE, scheme_name="session", auto_error=False)
# Same pattern as stream names (dextouch.streams.StreamDescriptor).
CameraName = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_]{0,63}$")]
# Finds a topic by its name; None where it knows none.
TopicFinder = Callable[[str], Topic | None]
# Headers of a response that a browser needs to show and to cache it.
PASSED_HEADERS: Final = (
    "content-type",
    "etag",
    "cache-control",
    "location",
    "content-disposition",
    "x-dextouch-estimated-bytes",
)
# What a user asked for may take longer to compute than the state that pages fetch again and again.
TIMEOUT_S: Final = 60.0
# Without a byte of a download: the time in which the store exports a long recording.
DOWNLOAD_TIMEOUT_S: Final = 600.0


class Subscription(FrozenModel):
    """Message of a page: the topics that are in view."""

    view: tuple[Annotated[str, Field(max_length=64)], ...] = Field(max_length=16)


def api_router(settings: DashboardSettings, fleet: Fleet, sessions: Sessions) -> APIRouter:
    """Router of the page's data and actions."""
    guards = [Depends(sessions.guard), Depends(SESSION)]
    # Every route takes the name of a station, which may be unknown.
    router = APIRouter(prefix="/v1", dependencies=guards, tags=["dashboard"], responses={404: {}})
    Station = Annotated[Feeds, Depends(fleet.of)]
    layout = {**heatmap_layout(), "bones": skeleton_bones()}

    @router.get("/heatmap", responses={200: {"model": HeatmapLayout}})
    async def get_heatmap_layout() -> JSONResponse:
        """Layout and colours of the taxel maps, and the bones of a hand's keypoints."""
        return JSONResponse(layout)

    @router.get("/overview")
    async def get_overview(feeds: Station) -> OverviewView:
        """Everything that the page shows, as JSON."""
        station, services, takes = await asyncio.gather(
            feeds.station(), feeds.services(), feeds.takes()
        )
        return OverviewView(
            name=settings.station,
            station=station,
            services=tuple(services),
            takes=takes.takes,
            takes_note=takes.note,
            refused=takes.refused,
        )

    @router.post("/recorder/{action}")
    async def operate_recorder(
        action: str,
        body: Annotated[dict[str, Any], Body(examples=[{"success": True}])],
        feeds: Station,
    ) -> RecorderView:
        """Arm, record, stop, save (`success` required) or discard; the recorder's new state."""
        return await feeds.operate(action, body)

    @router.post("/uploads/{recording_id}/retry", status_code=204)
    async def retry_upload(recording_id: str, feeds: Station) -> None:
        """Upload a refused take again."""
        path = f"/v1/uploads/{path_part(recording_id)}/retry"
        await feeds.upstream("acquisition").send("POST", path)

    @router.get(
        "/cameras/{name}.jpg",
        response_class=Response,
        responses={200: {"content": {"image/jpeg": {}}}},
    )
    async def get_camera_image(name: CameraName, feeds: Station) -> Response:
        """The newest image of one camera."""
        image = await feeds.upstream("acquisition").send("GET", f"/v1/live/cameras/{name}")
        media_type = image.headers.get("content-type", "image/jpeg")
        return Response(image.content, media_type=media_type, headers={"cache-control": "no-store"})

    return router


def comparison_router(comparisons: Comparisons, sessions: Sessions) -> APIRouter:
    """Router of the replay of an episode in two worlds at once."""
    guards = [Depends(sessions.guard), Depends(SESSION)]
    router = APIRouter(prefix="/v1/comparisons", dependencies=guards, tags=["comparison"])

    @router.post("", status_code=202)
    @takes({JSON: KIB})
    async def start_comparison(body: StartComparison) -> ComparisonView:
        """Replay an episode, or begin with hands to be moved; ends the comparison before."""
        return await comparisons.start(body)

    @router.post("/{comparison_id}/moves")
    @takes({JSON: KIB})
    async def move_hands(comparison_id: str, body: Moves) -> ComparisonView:
        """Move the hands for one chunk of actions in both worlds."""
        return await comparisons.move(comparison_id, body)

    @router.post("/stop", status_code=204)
    async def stop_comparison() -> None:
        """End the running comparison and its rollouts."""
        await comparisons.stop()

    @router.get(
        "/{comparison_id}/chunks/{number}",
        response_class=Response,
        responses={200: {"content": {OCTETS: {}}}},
    )
    async def get_comparison_chunk(comparison_id: str, number: int) -> Response:
        """Images and touch of both worlds over one chunk."""
        headers = {"cache-control": "no-store"}
        content = comparisons.chunk(comparison_id, number)
        return Response(content, headers=headers, media_type=OCTETS)

    return router


def system_router(
    system: System, log: AuditLog, sessions: Sessions, store: Upstream | None
) -> APIRouter:
    """Router of the state of all services, and of the audit log."""
    guards = [Depends(sessions.guard), Depends(SESSION)]
    router = APIRouter(prefix="/v1", dependencies=guards, tags=["system"])

    @router.get("/system")
    async def get_system() -> SystemView:
        """Services, disks and queues."""
        return await system.read()

    @router.get("/audit")
    async def list_audit_entries(
        limit: Annotated[int, Query(ge=1, le=1000)] = 100,
        action: Annotated[str | None, Query(max_length=200)] = None,
        person: Annotated[str | None, Query(max_length=64)] = None,
    ) -> AuditPage:
        """Requests that changed something, or were refused, newest first."""
        used, problem = await used_tokens(store)
        newest = partial(log.newest, limit, action=action, person=person, others=used)
        found = await run_in_threadpool(newest)
        return found.model_copy(update={"actions": ALL_ACTIONS, "no_used_tokens": problem})

    return router


def live_router(fleet: Fleet, finders: Sequence[TopicFinder], sessions: Sessions) -> APIRouter:
    """WebSocket router: the page subscribes to the topics in view and receives their updates."""
    router = APIRouter()

    @router.websocket("/v1/live")
    async def live(websocket: WebSocket) -> None:
        try:
            sessions.guard(websocket)
        except AccessDeniedError as error:
            await websocket.close(WEBSOCKET_REFUSED, error.message[:120])
            return
        try:
            topics = fleet.topics(websocket.query_params.get("station"))
        except NotFoundError as error:
            await websocket.close(WEBSOCKET_REFUSED, error.message[:120])
            return
        await websocket.accept()
        known: tuple[TopicFinder, ...] = (topics.get, *finders)
        session = asyncio.create_task(_close_with_session(websocket, sessions))
        senders: dict[str, asyncio.Task[None]] = {}
        try:
            while (message := await websocket.receive())["type"] == "websocket.receive":
                names = _view(message.get("text") or "")
                found = [(name, _topic(name, known)) for name in names]
                wanted = {name: topic for name, topic in found if topic is not None}
                for name in senders.keys() - wanted.keys():
                    senders.pop(name).cancel()
                for name in wanted.keys() - senders.keys():
                    sending = _send(websocket, wanted[name], sessions)
                    senders[name] = asyncio.create_task(sending)
        finally:
            tasks = (session, *senders.values())
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    return router


def _topic(name: str, finders: Sequence[TopicFinder]) -> Topic | None:
    """The first topic of a name that a finder knows."""
    return next((topic for find in finders if (topic := find(name)) is not None), None)


async def _send(websocket: WebSocket, topic: Topic, sessions: Sessions) -> None:
    """Send the updates of a topic until the session or the connection ends."""
    with suppress(AccessDeniedError, WebSocketDisconnect, RuntimeError):
        async for messages in topic.updates():
            for message in messages:
                sessions.guard(websocket)
                if isinstance(message, bytes):
                    await websocket.send_bytes(message)
                else:
                    await websocket.send_text(message)


async def _close_with_session(websocket: WebSocket, sessions: Sessions) -> None:
    try:
        while True:
            sessions.guard(websocket)
            await asyncio.sleep(SESSION_CHECK_S)
    except AccessDeniedError as error:
        await websocket.close(WEBSOCKET_REFUSED, error.message)


def _view(text: str) -> tuple[str, ...]:
    """Topics that a page subscribes to; invalid messages give none."""
    try:
        return Subscription.model_validate_json(text).view
    except ValidationError:
        return ()


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
        names = {name: path_part(value) for name, value in request.path_params.items()}
        path = f"/v1{route.path}".format(**names)
        query, feeds = request.query_params, fleet.of()
        if route.service == "acquisition":
            feeds = fleet.of(query.get("station"))
            query = QueryParams(
                [(key, value) for key, value in query.multi_items() if key != "station"]
            )
        if query:
            path += f"?{query}"
        known = request.headers.get("if-none-match")
        content = await request.body() if route.action else b""
        answer = await feeds.upstream(route.service).send(
            route.method,
            path,
            content,
            headers=({"if-none-match": known} if known else {})
            | ({"content-type": JSON} if content else {}),
            timeout_s=DOWNLOAD_TIMEOUT_S if route.streamed else TIMEOUT_S,
            stream=route.streamed,
        )
        passed = {name: answer.headers[name] for name in PASSED_HEADERS if name in answer.headers}
        if route.streamed:
            pieces = answer.aiter_bytes()
            return StreamedResponse(
                pieces, answer.status_code, headers=passed, on_end=answer.aclose
            )
        return Response(answer.content, answer.status_code, headers=passed)

    return takes({JSON: route.max_kib * KIB})(forward) if route.method == "POST" else forward
