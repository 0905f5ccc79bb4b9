"""HTTP routes of a station: the recorder, its health, live views and uploads."""

from typing import TYPE_CHECKING, Annotated, Literal

from fastapi import APIRouter, Body, Depends, Query, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from dextouch import schemas
from dextouch.errors import ConflictError
from dextouch.frozen_model import FrozenModel
from dextouch.serving import JSON, MSGPACK, RequireScope
from dextouch.streams import MAX_STREAMS, pack
from services.acquisition.health.history import NUM_ROWS, encoded_history
from services.acquisition.health.monitor import PERIOD_NS
from services.acquisition.health.station import DiskCheck, judge_uploads
from services.acquisition.station import Station
from services.acquisition.uploader import Uploader

if TYPE_CHECKING:
    from services.acquisition.mock_station import MockStation

Named = Annotated[schemas.TakeName | None, Body()]


def recorder_router(station: Station) -> APIRouter:
    """State and actions of the recorder."""
    router = _router("/v1/recorder", "recorder")
    recorder = station.recorder

    @router.get("")
    async def get_recorder() -> schemas.RecorderStatus:
        """Current state of the recorder."""
        return await run_in_threadpool(recorder.status)

    @router.post("/arm")
    async def arm_recorder(prompt: schemas.TakePrompt) -> schemas.RecorderStatus:
        """Announce task and instruction."""
        return await run_in_threadpool(recorder.arm, prompt)

    @router.post("/record")
    async def start_recording(take: Named = None) -> schemas.RecorderStatus:
        """Start the take."""
        return await run_in_threadpool(recorder.record, take.recording_id if take else None)

    @router.post("/stop")
    async def stop_recording(take: Named = None) -> schemas.RecorderStatus:
        """End the take and check it."""
        return await run_in_threadpool(recorder.stop, take.recording_id if take else None)

    @router.post("/save")
    async def save_take(
        how: Annotated[schemas.SaveTake | None, Body()] = None,
    ) -> schemas.RecorderStatus:
        """Keep the take."""
        return await run_in_threadpool(recorder.save, how or schemas.SaveTake())

    @router.post("/discard")
    async def discard_take(take: Named = None) -> schemas.RecorderStatus:
        """Throw the take away."""
        return await run_in_threadpool(recorder.discard, take.recording_id if take else None)

    @router.post("/rerecord")
    async def rerecord_take(take: Named = None) -> schemas.RecorderStatus:
        """Throw the take away and arm the same prompt again."""
        return await run_in_threadpool(recorder.rerecord, take.recording_id if take else None)

    @router.post("/session")
    async def begin_session() -> schemas.RecorderStatus:
        """Begin a session: the count of saved takes starts at zero."""
        return await run_in_threadpool(recorder.begin_session)

    return router


def faults_router(mock: "MockStation | None") -> APIRouter:
    """Faults that a simulated station shows on request; real ones have none (409)."""
    router = _router("/v1/faults")

    @router.post("/{fault}")
    async def set_fault(
        fault: schemas.SimulatedFault, body: schemas.SetFault
    ) -> tuple[schemas.SimulatedFault, ...]:
        """Begin or end a fault; those that are on."""
        if mock is None:
            raise ConflictError(
                f"fault {fault}: this station has real devices, expected simulated ones "
                "(dextouch up --mock); nothing was changed"
            )
        return await run_in_threadpool(mock.set_fault, fault, is_on=body.on)

    return router


class HistoryQuery(FrozenModel):
    """Which rows of the health's history, and in which format."""

    stream: tuple[str, ...] = Field(default=(), max_length=MAX_STREAMS)
    since_ns: int = Field(default=0, ge=0, lt=2**63)
    limit: int = Field(default=600, ge=1, le=NUM_ROWS)
    format: Literal["json", "msgpack"] = "json"


def station_router(station: Station, uploader: Uploader) -> APIRouter:
    """Health and live views."""
    disk = DiskCheck(station.recorder.spool_root, station.supervisors, station.clock.now_ns())
    station.health.watch(disk)
    station.health.watch(lambda evaluation: judge_uploads(evaluation, uploader.refused))
    router = _router("/v1")

    @router.get("/health")
    async def get_station_health() -> schemas.StationHealth:
        """Every stream and device."""
        health = await run_in_threadpool(station.health.report)
        return health.model_copy(update={"faults": station.faults})

    @router.get("/health/events")
    async def list_health_events(since_ns: int = 0) -> schemas.HealthEvents:
        """When something was raised and when it ended, on the station's clock."""
        return station.health.events(since_ns)

    @router.get(
        "/health/history",
        response_class=Response,
        responses={200: {"model": schemas.HealthHistory, "content": {MSGPACK: {}}}},
    )
    async def get_health_history(query: Annotated[HistoryQuery, Query()]) -> Response:
        """Health of the newest hour, about a row a second, and all takes of that hour.

        Packed, it has the arrays `t_ns` [rows], `station` [series, rows] and `streams` [stream,
        series, rows], float32, NaN where a value is unknown, in the order of the fields
        `station_series`, `nominal_rate_hz` and `stream_series`.
        """
        health = station.health
        rows = health.history.rows(query.stream, since_ns=query.since_ns, limit=query.limit)
        rates_hz = {name: health.nominal_rates_hz[name] for name in rows.streams}
        now_ns = station.clock.now_ns()
        takes = health.history.takes(now_ns - NUM_ROWS * PERIOD_NS)
        is_packed = query.format == "msgpack"
        body = encoded_history(rows, now_ns, takes, rates_hz, packed=is_packed)
        return Response(body, media_type=MSGPACK if is_packed else JSON)

    return router


def uploads_router(uploader: Uploader) -> APIRouter:
    """Saved takes on their way to the store."""
    router = _router("/v1/uploads")

    @router.get("")
    async def list_uploads(refused: Annotated[bool, Query()] = False) -> list[schemas.UploadStatus]:  # noqa: FBT002 - a query's flag
        """Saved takes and whether the store has them; with `refused`, those alone it refused."""
        return await run_in_threadpool(uploader.status, only_refused=refused)

    @router.get("/{recording_id}")
    async def get_upload(recording_id: schemas.StoreId) -> schemas.UploadStatus:
        """One saved take and whether the store has it."""
        return await run_in_threadpool(uploader.status_of, recording_id)

    @router.post("/{recording_id}/retry")
    async def retry_upload(recording_id: schemas.StoreId) -> schemas.UploadStatus:
        """Send a take again that the store refused."""
        return await run_in_threadpool(uploader.retry, recording_id)

    return router


def live_router(station: Station) -> APIRouter:
    """What a station shows at this moment: taxels, poses, cameras, and a tile of a wall."""
    router = _router("/v1/live")

    @router.get("/overview", response_class=Response, responses={200: {"content": {MSGPACK: {}}}})
    async def get_live_overview() -> Response:
        """A `StationOverview` and the newest pressures of the gloves that are heard, packed."""
        fields = await run_in_threadpool(station_overview, station)
        pressures = station.live.pressures_kpa(station.clock.now_ns())
        return Response(pack(fields.model_dump(mode="json"), pressures), media_type=MSGPACK)

    @router.get("/taxels", response_class=Response, responses={200: {"content": {MSGPACK: {}}}})
    async def get_live_taxels() -> Response:
        """Newest pressures (kPa, float32 [taxels]) of the gloves that are heard, packed."""
        pressures = station.live.pressures_kpa(station.clock.now_ns())
        return Response(pack({}, pressures), media_type=MSGPACK)

    @router.get("/poses", response_class=Response, responses={200: {"content": {MSGPACK: {}}}})
    async def get_live_poses(mounted: Annotated[bool, Query()] = True) -> Response:  # noqa: FBT002 - a query's flag
        """Newest poses and keypoints that are at most 0.5 s old, age and delay of each stream's.

        Poses are those of the bodies; with `mounted=false` those of the trackers on them.
        """
        now_ns = station.clock.now_ns()
        fields = {
            "age_s": station.live.ages_s({"pose", "keypoints"}, now_ns),
            "late_s": station.live.late_s({"pose", "keypoints"}),
        }
        poses = station.live.poses(now_ns, mounted=mounted)
        return Response(pack(fields, poses), media_type=MSGPACK)

    @router.get("/cameras")
    async def list_cameras() -> schemas.CameraList:
        """Cameras that have sent an image."""
        return schemas.CameraList(cameras=tuple(station.live.cameras(station.clock.now_ns())))

    @router.get(
        "/cameras/{name}", response_class=Response, responses={200: {"content": {"image/jpeg": {}}}}
    )
    async def get_camera_image(name: str) -> Response:
        """Newest image as JPEG."""
        image = station.live.jpeg(name, station.clock.now_ns())
        return Response(image, media_type="image/jpeg")

    return router


def station_overview(station: Station) -> schemas.StationOverview:
    """The station in a few values, for a page that shows many stations."""
    health, recorder = station.health.report(), station.recorder.status()
    ages_s = [stream.age_s for stream in health.streams if stream.age_s is not None]
    widest = next((cause for cause in health.causes if cause.level == health.level), None)
    return schemas.StationOverview(
        station=station.name,
        level=health.level,
        cause=widest.message if widest else "",
        advice=widest.advice if widest else "",
        recorder=recorder.state,
        task=recorder.prompt.task if recorder.prompt else None,
        duration_s=recorder.duration_s,
        age_s=min(ages_s, default=None),
        disk_left_s=health.figures.get("disk_left_seconds"),
        disk_free_bytes=health.figures.get("disk_free_bytes"),
        cameras=tuple(station.live.cameras(station.clock.now_ns())),
        layouts={
            stream.hand: stream.layout
            for stream in health.streams
            if stream.layout is not None
            and stream.hand
            and stream.stream == f"tactile_{stream.hand}"
        },
    )


def _router(prefix: str, tag: str = "station") -> APIRouter:
    dependencies = [Depends(RequireScope("station"))]
    return APIRouter(prefix=prefix, tags=[tag], dependencies=dependencies)
