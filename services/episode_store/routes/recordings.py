"""Recordings over HTTP: stations send batches in, finished takes are listed and read."""

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from dextouch.schemas.recordings import (
    BatchReceipt,
    FinishRecording,
    RecordingAttributes,
    RecordingList,
    RecordingStatus,
)
from dextouch.serving.access import RequireScope
from services.episode_store.catalog import Catalog
from services.episode_store.ingest import Ingest
from services.episode_store.reading import MSGPACK, StoreReader

READ_SCOPE, WRITE_SCOPE = "store_read", "store_write"


def recordings_router(
    *, ingest: Ingest, catalog: Catalog, reader: StoreReader, max_page: int
) -> APIRouter:
    """Routes under /v1/recordings."""
    router = APIRouter(prefix="/v1/recordings", tags=["recordings"])
    may_read = [Depends(RequireScope(READ_SCOPE))]
    may_write = [Depends(RequireScope(WRITE_SCOPE))]

    @router.post("", status_code=201, dependencies=may_write)
    def create(attributes: RecordingAttributes) -> RecordingStatus:
        """Begin an upload; repeating it says where it stands."""
        return ingest.create(attributes)

    @router.post(
        "/{recording_id}/streams/{stream}/batches/{number}",
        dependencies=may_write,
        openapi_extra={"requestBody": {"content": {"application/octet-stream": {}}}},
    )
    async def put_batch(
        recording_id: str, stream: str, number: Annotated[int, Path(ge=0)], request: Request
    ) -> BatchReceipt:
        """Take batch n of a stream in (wire format v1), exactly once however often it comes."""
        data = await request.body()
        return await run_in_threadpool(ingest.put_batch, recording_id, stream, number, data)

    @router.post("/{recording_id}/finish", dependencies=may_write)
    def finish(recording_id: str, body: FinishRecording) -> RecordingStatus:
        """Move a complete upload into the store."""
        return ingest.finish(recording_id, body)

    @router.get("", dependencies=may_read)
    def listing(
        limit: int = Query(default=max_page, ge=1, le=max_page),
        offset: int = Query(default=0, ge=0),
    ) -> RecordingList:
        """Finished recordings."""
        return catalog.recordings(limit=limit, offset=offset)

    @router.get("/{recording_id}", dependencies=may_read)
    def status(recording_id: str) -> RecordingStatus:
        """Where an upload stands."""
        return ingest.status(recording_id)

    @router.get("/{recording_id}/attributes", dependencies=may_read)
    def attributes(recording_id: str) -> RecordingAttributes:
        """What a finished recording says about itself."""
        return reader.recording_attributes(recording_id)

    @router.get("/{recording_id}/streams/{stream}", dependencies=may_read)
    def samples(
        recording_id: str, stream: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Response:
        """Samples of a finished recording with start_ns ≤ t_host_ns < stop_ns, as msgpack."""
        data = reader.recording_samples(recording_id, stream, start_ns, stop_ns)
        return Response(data, media_type=MSGPACK)

    return router
