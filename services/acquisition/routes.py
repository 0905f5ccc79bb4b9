"""The station over HTTP: recorder actions come in; state, health and live views go out."""

from typing import Annotated

from fastapi import APIRouter, Body, Depends, Response
from starlette.concurrency import run_in_threadpool

from dextouch.serving.access import RequireScope
from dextouch.streams.packing import pack
from services.acquisition.schemas import (
    CameraList,
    RecorderStatus,
    SaveTake,
    StationHealth,
    TakePrompt,
    UploadStatus,
)
from services.acquisition.station import Station
from services.acquisition.uploader import Uploader

SCOPE = "station"


def recorder_router(station: Station) -> APIRouter:
    """State and actions of the recorder."""
    router = APIRouter(
        prefix="/v1/recorder", tags=["recorder"], dependencies=[Depends(RequireScope(SCOPE))]
    )
    recorder = station.recorder

    @router.get("")
    async def status() -> RecorderStatus:
        """Where the recorder stands."""
        return await run_in_threadpool(recorder.status)

    @router.post("/arm")
    async def arm(prompt: TakePrompt) -> RecorderStatus:
        """Announce task and instruction."""
        return await run_in_threadpool(recorder.arm, prompt)

    @router.post("/record")
    async def record() -> RecorderStatus:
        """Start the take."""
        return await run_in_threadpool(recorder.record)

    @router.post("/stop")
    async def stop() -> RecorderStatus:
        """End the take and check it."""
        return await run_in_threadpool(recorder.stop)

    @router.post("/save")
    async def save(how: Annotated[SaveTake | None, Body()] = None) -> RecorderStatus:
        """Keep the take."""
        return await run_in_threadpool(recorder.save, how or SaveTake())

    @router.post("/discard")
    async def discard() -> RecorderStatus:
        """Throw the take away."""
        return await run_in_threadpool(recorder.discard)

    return router


def station_router(station: Station, uploader: Uploader) -> APIRouter:
    """Health, live views and uploads."""
    router = APIRouter(prefix="/v1", tags=["station"], dependencies=[Depends(RequireScope(SCOPE))])

    @router.get("/health")
    async def health() -> StationHealth:
        """Every stream and device."""
        return station.health.report()

    @router.get("/live/taxels")
    async def taxels() -> Response:
        """Newest pressures (kPa, float32 [320]) of the gloves that are heard, packed."""
        pressures = station.live.pressures_kpa(station.clock.now_ns())
        return Response(pack({}, pressures), media_type="application/msgpack")

    @router.get("/live/cameras")
    async def cameras() -> CameraList:
        """Cameras that have sent an image."""
        return CameraList(cameras=tuple(station.live.cameras(station.clock.now_ns())))

    @router.get("/live/cameras/{name}")
    async def camera(name: str) -> Response:
        """Newest image as JPEG."""
        image = station.live.jpeg(name, station.clock.now_ns())
        return Response(image, media_type="image/jpeg")

    @router.get("/uploads")
    async def uploads() -> list[UploadStatus]:
        """Saved takes and whether the store has them."""
        return await run_in_threadpool(uploader.status)

    return router
