"""HTTP routes of a station: the recorder, its health, live views and uploads."""

from typing import Annotated

from fastapi import APIRouter, Body, Depends, Query, Response
from starlette.concurrency import run_in_threadpool

from dextouch.schemas import (
    CameraList,
    HealthEvents,
    RecorderStatus,
    SaveTake,
    StationHealth,
    StoreId,
    TakeName,
    TakePrompt,
    UploadStatus,
)
from dextouch.serving import MSGPACK, RequireScope
from dextouch.streams import pack
from services.acquisition.health import DiskJudge, judge_uploads
from services.acquisition.station import Station
from services.acquisition.uploader import Uploader

SCOPE = "station"
Named = Annotated[TakeName | None, Body()]


def recorder_router(station: Station) -> APIRouter:
    """State and actions of the recorder."""
    router = APIRouter(
        prefix="/v1/recorder", tags=["recorder"], dependencies=[Depends(RequireScope(SCOPE))]
    )
    recorder = station.recorder

    @router.get("")
    async def status() -> RecorderStatus:
        """Current state of the recorder."""
        return await run_in_threadpool(recorder.status)

    @router.post("/arm")
    async def arm(prompt: TakePrompt) -> RecorderStatus:
        """Announce task and instruction."""
        return await run_in_threadpool(recorder.arm, prompt)

    @router.post("/record")
    async def record(take: Named = None) -> RecorderStatus:
        """Start the take."""
        return await run_in_threadpool(recorder.record, take.recording_id if take else None)

    @router.post("/stop")
    async def stop(take: Named = None) -> RecorderStatus:
        """End the take and check it."""
        return await run_in_threadpool(recorder.stop, take.recording_id if take else None)

    @router.post("/save")
    async def save(how: Annotated[SaveTake | None, Body()] = None) -> RecorderStatus:
        """Keep the take."""
        return await run_in_threadpool(recorder.save, how or SaveTake())

    @router.post("/discard")
    async def discard(take: Named = None) -> RecorderStatus:
        """Throw the take away."""
        return await run_in_threadpool(recorder.discard, take.recording_id if take else None)

    @router.post("/rerecord")
    async def rerecord(take: Named = None) -> RecorderStatus:
        """Throw the take away and arm the same prompt again."""
        return await run_in_threadpool(recorder.rerecord, take.recording_id if take else None)

    return router


def station_router(station: Station, uploader: Uploader) -> APIRouter:
    """Health, live views and uploads."""
    disk = DiskJudge(station.recorder.spool_root, station.supervisors, station.clock.now_ns())
    station.health.watch(disk)
    station.health.watch(lambda evaluation: judge_uploads(evaluation, uploader.refused))
    router = APIRouter(
        prefix="/v1",
        tags=["station"],
        dependencies=[Depends(RequireScope(SCOPE))],
    )

    @router.get("/health")
    async def health() -> StationHealth:
        """Every stream and device."""
        return await run_in_threadpool(station.health.report)

    @router.get("/health/events")
    async def events(since_ns: int = 0) -> HealthEvents:
        """When something was raised and when it ended, on the station's clock."""
        return station.health.events(since_ns)

    @router.get(
        "/live/taxels", response_class=Response, responses={200: {"content": {MSGPACK: {}}}}
    )
    async def taxels() -> Response:
        """Newest pressures (kPa, float32 [320]) of the gloves that are heard, packed."""
        pressures = station.live.pressures_kpa(station.clock.now_ns())
        return Response(pack({}, pressures), media_type=MSGPACK)

    @router.get("/live/cameras")
    async def cameras() -> CameraList:
        """Cameras that have sent an image."""
        return CameraList(cameras=tuple(station.live.cameras(station.clock.now_ns())))

    @router.get(
        "/live/cameras/{name}",
        response_class=Response,
        responses={200: {"content": {"image/jpeg": {}}}},
    )
    async def camera(name: str) -> Response:
        """Newest image as JPEG."""
        image = station.live.jpeg(name, station.clock.now_ns())
        return Response(image, media_type="image/jpeg")

    @router.get("/uploads")
    async def uploads(refused: Annotated[bool, Query()] = False) -> list[UploadStatus]:  # noqa: FBT002 - a query's flag
        """Saved takes and whether the store has them; with `refused`, those alone it refused."""
        return await run_in_threadpool(uploader.status, only_refused=refused)

    @router.post("/uploads/{recording_id}/retry")
    async def retry(recording_id: StoreId) -> UploadStatus:
        """Send a take again that the store refused."""
        return await run_in_threadpool(uploader.retry, recording_id)

    return router
