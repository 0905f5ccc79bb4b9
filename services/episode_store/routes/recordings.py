"""Routes of /v1/recordings: uploads by stations, list, attributes and samples."""

from typing import Annotated

from fastapi import APIRouter, Header, Path, Query, Request, Response

from dextouch.schemas import (
    BatchReceipt,
    FinishRecording,
    RecordingAttributes,
    RecordingList,
    RecordingStatus,
)
from dextouch.serving import AS_SET, JSON, OCTETS, takes
from services.episode_store.catalog import Catalog
from services.episode_store.filters import RecordingQuery
from services.episode_store.intake import Intake
from services.episode_store.reading import SpanQuery, StoreReader
from services.episode_store.routes.media import MSGPACK, as_response
from services.episode_store.routes.scopes import MAY_READ, MAY_WRITE

# Room for the calibration and descriptors of a station, or the ledger of a take.
MAX_ATTRIBUTES_BYTES = 2**20


def recordings_router(
    *, intake: Intake, catalog: Catalog, reader: StoreReader, max_page: int
) -> APIRouter:
    """Create the router."""
    router = APIRouter(prefix="/v1/recordings", tags=["recordings"])

    @router.post("", status_code=201, dependencies=[MAY_WRITE])
    @takes({JSON: MAX_ATTRIBUTES_BYTES})
    def create(attributes: RecordingAttributes) -> RecordingStatus:
        """Begin an upload, or return the status of an existing one."""
        return intake.create(attributes)

    @router.post(
        "/{recording_id}/streams/{stream}/batches/{number}",
        dependencies=[MAY_WRITE],
        openapi_extra={"requestBody": {"content": {OCTETS: {}}}},
    )
    @takes({OCTETS: AS_SET})
    async def put_batch(
        recording_id: str, stream: str, number: Annotated[int, Path(ge=0)], request: Request
    ) -> BatchReceipt:
        """Store batch n of a stream (wire format v2 or v1), exactly once even if it is repeated."""
        announced = request.headers.get("content-length")
        return await intake.put_batch(
            recording_id, stream, number, announced=announced, read=request.body
        )

    @router.post("/{recording_id}/finish", dependencies=[MAY_WRITE])
    @takes({JSON: MAX_ATTRIBUTES_BYTES})
    def finish(recording_id: str, body: FinishRecording) -> RecordingStatus:
        """Commit a complete upload."""
        return intake.finish(recording_id, body)

    @router.get("", dependencies=[MAY_READ])
    def listing(wanted: Annotated[RecordingQuery, Query()]) -> RecordingList:
        """List finished recordings that match all filters."""
        limit = wanted.num_rows(max_page)
        return catalog.recordings(wanted, limit=limit, offset=wanted.offset, after=wanted.after)

    @router.get("/{recording_id}", dependencies=[MAY_READ])
    def status(recording_id: str) -> RecordingStatus:
        """Status of an upload."""
        return intake.status(recording_id)

    @router.get("/{recording_id}/attributes", dependencies=[MAY_READ])
    def attributes(recording_id: str) -> RecordingAttributes:
        """Attributes of a finished recording."""
        return reader.recording_attributes(recording_id)

    @router.get("/{recording_id}/streams/{stream}", dependencies=[MAY_READ])
    def samples(
        recording_id: str,
        stream: str,
        span: Annotated[SpanQuery, Query()],
        if_none_match: Annotated[str | None, Header()] = None,
    ) -> Response:
        """Samples of a finished recording with start_ns ≤ t_host_ns < stop_ns, as msgpack."""
        answer = reader.samples("recording", recording_id, stream, span, known=if_none_match)
        return as_response(answer, MSGPACK)

    return router
