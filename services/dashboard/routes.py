"""HTTP and WebSocket routes of the page: data, live updates and recorder actions."""

import asyncio
import json
from contextlib import suppress
from typing import Annotated, Literal

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
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocketState

from dextouch.errors import AccessDeniedError, InvalidInputError
from dextouch.serving import not_signed_in
from services.dashboard.feeds import Feeds
from services.dashboard.sessions import Sessions
from services.dashboard.settings import DashboardSettings
from services.dashboard.topics import Message, Viewer
from services.dashboard.views import heatmap_layout

MAX_VIEW_CHARACTERS = 1000
WEBSOCKET_REFUSED = 1008
# Interval at which a WebSocket checks that its session is still valid.
SESSION_CHECK_S = 1.0
# Same pattern as stream names (dextouch.streams.StreamDescriptor).
CameraName = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_]{0,63}$")]


class RecorderRequest(BaseModel):
    """Body of a recorder action: a prompt for `arm`, an outcome for `save`.

    `success` is true, false or null (not judged), and required for `save`. `recording_id` is the
    take that the action refers to.
    """

    model_config = ConfigDict(extra="forbid")

    recording_id: str | None = Field(default=None, max_length=128)
    task: str | None = Field(default=None, min_length=1, max_length=128)
    instruction: str | None = Field(default=None, min_length=1, max_length=2000)
    domain: Literal["human", "robot"] | None = None
    operator: str | None = Field(default=None, min_length=1, max_length=128)
    consent: bool | None = None
    success: bool | None = None
    accept_incomplete: bool | None = None


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
        return JSONResponse(
            {
                "name": settings.station,
                "station": station.model_dump(),
                "services": [view.model_dump() for view in services],
                "takes": [view.model_dump() for view in takes.takes],
                "takes_note": takes.note,
                "refused": [view.model_dump() for view in takes.refused],
            }
        )

    @router.post("/recorder/{action}")
    async def operate(
        action: str, request: Request, wanted: Annotated[RecorderRequest, Body()]
    ) -> JSONResponse:
        """Arm, record, stop, save or discard; returns the recorder's new state."""
        if action == "save" and "success" not in wanted.model_fields_set:
            raise InvalidInputError(
                "save: got no outcome, expected success: true, false or null (not judged)"
            )
        feeds: Feeds = request.app.state.feeds
        return JSONResponse(await feeds.operate(action, wanted.model_dump(exclude_unset=True)))

    @router.post("/uploads/{recording_id}/retry", status_code=204)
    async def retry(recording_id: str, request: Request) -> None:
        """Upload a refused take again."""
        feeds: Feeds = request.app.state.feeds
        await feeds.retry(recording_id)

    @router.get("/cameras/{name}.jpg")
    async def camera(name: CameraName, request: Request) -> Response:
        """The newest image of one camera."""
        feeds: Feeds = request.app.state.feeds
        content, media_type = await feeds.camera_image(name)
        return Response(content, media_type=media_type, headers={"cache-control": "no-store"})

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


def _view(text: str) -> list[str]:
    """Parse the topics that a page subscribes to; invalid messages give none."""
    if len(text) > MAX_VIEW_CHARACTERS:
        return []
    try:
        wanted = json.loads(text)
    except ValueError:
        return []
    names = wanted.get("view", []) if isinstance(wanted, dict) else []
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []
