"""HTTP routes of the store: uploads by stations, and reading of recordings and episodes."""

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response

from dextouch.schemas import (
    BatchReceipt,
    CatalogHours,
    EpisodeDetail,
    EpisodeList,
    ExpireUploads,
    FinishRecording,
    RecordingAttributes,
    RecordingList,
    RecordingStatus,
    UploadList,
)
from dextouch.serving import AS_SET, JSON, KIB, MSGPACK, OCTETS, JsonBody, RequireScope, takes
from services.episode_store.catalog import Catalog, EpisodeFilter, EpisodeQuery, RecordingQuery
from services.episode_store.intake import Intake
from services.episode_store.reading import Answer, SpanQuery, StoreReader, WindowQuery

Attributes = Annotated[RecordingAttributes, Depends(JsonBody(RecordingAttributes))]
Finish = Annotated[FinishRecording, Depends(JsonBody(FinishRecording))]
Responses = dict[int | str, dict[str, Any]]
MAY_READ = Depends(RequireScope("store_read"))
MAY_WRITE = Depends(RequireScope("store_write"))
# Room for the calibration and descriptors of a station, or the ledger of a take.
MAX_ATTRIBUTES_BYTES = 256 * KIB
WINDOW_MSGPACK = "application/vnd.dextouch.window+msgpack"
# Committed content is immutable but may be deleted: clients must revalidate.
CACHE_CONTROL = "private, no-cache"
# Responses of these routes besides the problems that all routes can give.
SAMPLES: Responses = {200: {"content": {MSGPACK: {}}}, 304: {}}
WINDOW: Responses = {200: {"content": {WINDOW_MSGPACK: {}}}, 304: {}}
IfNoneMatch = Annotated[str | None, Header(alias="if-none-match")]


def uploads_router(intake: Intake) -> APIRouter:
    """Create the routes of uploads: /v1/recordings while they come, and /v1/uploads."""
    router = APIRouter(prefix="/v1")

    @router.post("/recordings", status_code=201, tags=["recordings"], dependencies=[MAY_WRITE])
    @takes({JSON: MAX_ATTRIBUTES_BYTES})
    def create(attributes: Attributes) -> RecordingStatus:
        """Begin an upload, or return the status of an existing one."""
        return intake.create(attributes)

    @router.post(
        "/recordings/{recording_id}/streams/{stream}/batches/{number}",
        tags=["recordings"],
        dependencies=[MAY_WRITE],
    )
    @takes({OCTETS: AS_SET})
    async def put_batch(
        recording_id: str, stream: str, number: Annotated[int, Path(ge=0)], request: Request
    ) -> BatchReceipt:
        """Store batch n of a stream (wire format v2 or v1), exactly once even if repeated."""
        announced = request.headers.get("content-length")
        return await intake.put_batch(
            recording_id, stream, number, announced=announced, read=request.body
        )

    @router.post("/recordings/{recording_id}/finish", tags=["recordings"], dependencies=[MAY_WRITE])
    @takes({JSON: MAX_ATTRIBUTES_BYTES})
    def finish(recording_id: str, body: Finish) -> RecordingStatus:
        """Commit a complete upload."""
        return intake.finish(recording_id, body)

    @router.get("/recordings/{recording_id}", tags=["recordings"], dependencies=[MAY_READ])
    def status(recording_id: str) -> RecordingStatus:
        """Status of an upload."""
        return intake.status(recording_id)

    @router.get("/uploads", tags=["uploads"], dependencies=[MAY_READ])
    def listing(idle_s: Annotated[float, Query(ge=0)] = 0.0) -> UploadList:
        """List unfinished uploads that have been idle for `idle_s`."""
        return intake.idle(idle_s=idle_s)

    @router.post("/uploads/expire", tags=["uploads"], dependencies=[MAY_WRITE])
    def expire(wanted: ExpireUploads) -> UploadList:
        """Drop such uploads with their data; the response lists them."""
        return intake.expire(wanted)

    return router


def catalog_router(catalog: Catalog, *, max_page: int) -> APIRouter:
    """Create the routes that list recordings and episodes, and sum up their hours."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_READ])

    @router.get("/recordings", tags=["recordings"])
    def recordings(wanted: Annotated[RecordingQuery, Query()]) -> RecordingList:
        """List finished recordings that match all filters."""
        limit = wanted.num_rows(max_page)
        return catalog.recordings(wanted, limit=limit, offset=wanted.offset, after=wanted.after)

    @router.get("/episodes", tags=["episodes"])
    def episodes(wanted: Annotated[EpisodeQuery, Query()]) -> EpisodeList:
        """List episodes that match all filters."""
        limit = wanted.num_rows(max_page)
        return catalog.episodes(wanted, limit=limit, offset=wanted.offset, after=wanted.after)

    @router.get("/catalog/hours", tags=["catalog"])
    def hours(wanted: Annotated[EpisodeFilter, Query()]) -> CatalogHours:
        """Hours and counts of the matching episodes by task, domain and origin."""
        return catalog.hours(wanted)

    return router


def content_router(reader: StoreReader) -> APIRouter:
    """Create the routes of single recordings and episodes."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_READ])

    @router.get("/recordings/{recording_id}/attributes", tags=["recordings"])
    def attributes(recording_id: str) -> RecordingAttributes:
        """Attributes of a finished recording."""
        return reader.recording_attributes(recording_id)

    @router.get(
        "/recordings/{recording_id}/streams/{stream}",
        tags=["recordings"],
        response_class=Response,
        responses=SAMPLES,
    )
    def recording_samples(
        recording_id: str,
        stream: str,
        span: Annotated[SpanQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Samples of a finished recording with start_ns ≤ t_host_ns < stop_ns, as msgpack."""
        answer = reader.samples("recording", recording_id, stream, span, known=if_none_match)
        return _response(answer, MSGPACK)

    @router.get("/episodes/{episode_id}", tags=["episodes"])
    def episode(episode_id: str) -> EpisodeDetail:
        """Attributes of an episode."""
        return reader.episode(episode_id)

    @router.get(
        "/episodes/{episode_id}/windows",
        tags=["episodes"],
        response_class=Response,
        responses=WINDOW,
    )
    def window(
        episode_id: str,
        query: Annotated[WindowQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Window of the model grid as msgpack (`dextouch.episodes.decode_window`)."""
        return _response(reader.window(episode_id, query, known=if_none_match), WINDOW_MSGPACK)

    @router.get(
        "/episodes/{episode_id}/streams/{stream}",
        tags=["episodes"],
        response_class=Response,
        responses=SAMPLES,
    )
    def episode_samples(
        episode_id: str,
        stream: str,
        span: Annotated[SpanQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Samples with start_ns ≤ t_ref_ns < stop_ns as msgpack."""
        answer = reader.samples("episode", episode_id, stream, span, known=if_none_match)
        return _response(answer, MSGPACK)

    return router


def _response(answer: Answer, media_type: str) -> Response:
    """Response with ETag; 304 without a body if the client has it already."""
    headers = {"etag": answer.etag, "cache-control": CACHE_CONTROL}
    if answer.data is None:
        return Response(status_code=304, headers=headers)
    return Response(answer.data, media_type=media_type, headers=headers)
