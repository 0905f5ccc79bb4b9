"""HTTP and WebSocket routes of the page: data, live updates and recorder actions."""

import asyncio
from contextlib import suppress
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import (
    APIRouter,
    Body,
    Depends,
    Path,
    Request,
    Response,
    WebSocket,
    WebSocketDisconnect,
)
from fastapi.responses import JSONResponse
from pydantic import Field, ValidationError
from pydantic_core import to_jsonable_python
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocketState

from dextouch.errors import AccessDeniedError
from dextouch.frozen_model import FrozenModel
from dextouch.serving import not_signed_in
from services.dashboard.feeds import Feeds
from services.dashboard.sessions import Sessions
from services.dashboard.settings import DashboardSettings
from services.dashboard.station_view import RecorderView
from services.dashboard.topics import Message, Viewer
from services.dashboard.touch import heatmap_layout

WEBSOCKET_REFUSED = 1008
# Interval at which a WebSocket checks that its session is still valid.
SESSION_CHECK_S = 1.0
# Same pattern as stream names (dextouch.streams.StreamDescriptor).
CameraName = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_]{0,63}$")]


class Subscription(FrozenModel):
    """Message of a page: the topics that are in view."""

    view: tuple[Annotated[str, Field(max_length=64)], ...] = Field(max_length=16)


def guard(connection: HTTPConnection) -> None:
    """Refuse browsers that are not signed in."""
    sessions: Sessions = connection.app.state.sessions
    if not sessions.allows(connection):
        raise not_signed_in()


def api_router(settings: DashboardSettings) -> APIRouter:
    """Router of the page's data and actions."""
    router = APIRouter(prefix="/v1", dependencies=[Depends(guard)], tags=["dashboard"])
    layout = heatmap_layout()

    @router.get("/heatmap")
    async def heatmap() -> JSONResponse:
        """Layout and colours of the taxel maps."""
        return JSONResponse(layout)

    @router.get("/overview")
    async def overview(request: Request) -> JSONResponse:
        """Everything that the page shows, as JSON."""
        feeds: Feeds = request.app.state.feeds
        station, services, takes = await asyncio.gather(
            feeds.station(), feeds.services(), feeds.takes()
        )
        shown = {"name": settings.station, "station": station, "services": services}
        shown |= {"takes": takes.takes, "takes_note": takes.note, "refused": takes.refused}
        return JSONResponse(to_jsonable_python(shown))

    @router.post("/recorder/{action}")
    async def operate(
        action: str, request: Request, body: Annotated[dict[str, Any], Body()]
    ) -> RecorderView:
        """Arm, record, stop, save (`success` required) or discard; the recorder's new state."""
        feeds: Feeds = request.app.state.feeds
        return await feeds.operate(action, body)

    @router.post("/uploads/{recording_id}/retry", status_code=204)
    async def retry(recording_id: str, request: Request) -> None:
        """Upload a refused take again."""
        feeds: Feeds = request.app.state.feeds
        path = f"/v1/uploads/{quote(recording_id, safe='')}/retry"
        await feeds.upstream("acquisition").send("POST", path)

    @router.get("/cameras/{name}.jpg")
    async def camera(name: CameraName, request: Request) -> Response:
        """The newest image of one camera."""
        feeds: Feeds = request.app.state.feeds
        image = await feeds.upstream("acquisition").send("GET", f"/v1/live/cameras/{name}")
        media_type = image.headers.get("content-type", "image/jpeg")
        return Response(image.content, media_type=media_type, headers={"cache-control": "no-store"})

    return router


def live_router() -> APIRouter:
    """WebSocket router: the page subscribes to the topics in view and receives their updates."""
    router = APIRouter()

    @router.websocket("/v1/live")
    async def live(websocket: WebSocket) -> None:
        try:
            guard(websocket)
        except AccessDeniedError as error:
            await websocket.close(WEBSOCKET_REFUSED, error.message[:120])
            return
        await websocket.accept()
        viewer = Viewer(websocket.app.state.feeds.topics)
        sender = asyncio.create_task(_send_news(websocket, viewer))
        try:
            with suppress(WebSocketDisconnect):
                while websocket.application_state is WebSocketState.CONNECTED:
                    viewer.look_at(_view(await websocket.receive_text()))
        finally:
            viewer.look_at(())
            sender.cancel()
            with suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sender

    return router


async def _send_news(websocket: WebSocket, viewer: Viewer) -> None:
    """Send updates until the session ends."""
    messages: list[Message] = []
    try:
        while True:
            guard(websocket)
            for message in messages:
                if isinstance(message, bytes):
                    await websocket.send_bytes(message)
                else:
                    await websocket.send_text(message)
            messages = []
            with suppress(TimeoutError):
                messages = await asyncio.wait_for(viewer.news(), SESSION_CHECK_S)
    except AccessDeniedError as error:
        await websocket.close(WEBSOCKET_REFUSED, error.message)


def _view(text: str) -> tuple[str, ...]:
    """Topics that a page subscribes to; invalid messages give none."""
    try:
        return Subscription.model_validate_json(text).view
    except ValidationError:
        return ()
