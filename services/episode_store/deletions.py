"""Permanently deleted takes: refused uploads, and stations that remove their copies."""

from collections import defaultdict
from typing import Annotated, Final

import structlog
from fastapi import APIRouter, Depends

from dextouch import schemas
from dextouch.episodes.maintenance import DeletionRecords, TakeFacts, take_start
from dextouch.errors import ConflictError
from dextouch.serving import JSON, KIB, JsonBody, takes
from services.episode_store.keys import MAY_DELETE, MAY_WRITE, Writer

logger = structlog.get_logger(__name__)

MAX_CHECK_BYTES: Final = 512 * KIB
Checked = Annotated[schemas.CheckTakes, Depends(JsonBody(schemas.CheckTakes))]


def refuse_deleted(records: DeletionRecords, attributes: schemas.RecordingAttributes) -> None:
    """Refuse a recording that was deleted permanently, or whose operator was.

    Raises ConflictError: with the reason `take_deleted`, or `operator_deleted` where the take began
    after the deletion.
    """
    covered = records.find(TakeFacts.of(attributes))
    if covered is None:
        return
    when = covered.deleted_at.isoformat(timespec="seconds")
    if not covered.is_later:
        raise ConflictError(
            f"recording {attributes.recording_id!r}: it was deleted permanently on {when}, with "
            "the operator or by its id; the store takes it no more, remove it from the spool",
            reason=schemas.TAKE_DELETED,
        )
    raise ConflictError(
        f"recording {attributes.recording_id!r}: its operator was deleted permanently on {when}, "
        "before this take began. If it is the same person, delete again; if the pseudonym is used "
        "anew, run `dextouch store deletions --readmit PSEUDONYM` and send the take again",
        reason=schemas.OPERATOR_DELETED,
    )


def deletions_router(records: DeletionRecords) -> APIRouter:
    """Create the routes below /v1/deletions."""
    router = APIRouter(prefix="/v1/deletions", tags=["deletions"])

    @router.get("", dependencies=[MAY_DELETE])
    def list_deletions() -> schemas.Deletions:
        """Deletions, and the takes that stations have yet to remove."""
        return schemas.Deletions(deletions=tuple(deletion_statuses(records)))

    @router.get("/revision", dependencies=[MAY_WRITE])
    def get_deletions_revision() -> schemas.DeletionsRevision:
        """Changes with every deletion; a station then checks its spool."""
        return schemas.DeletionsRevision(revision=records.revision)

    @router.post("/check", dependencies=[MAY_WRITE])
    @takes({JSON: MAX_CHECK_BYTES})
    def check_takes(body: Checked, sender: Writer) -> schemas.CheckedTakes:
        """Which of these takes were deleted, and which operators."""
        sender.check_station(body.station)
        # Before the takes, so that a deletion in between is found by the next check.
        revision = records.revision
        found = ((take, _deletion_of(records, body.station, take)) for take in body.takes)
        return schemas.CheckedTakes(
            revision=revision,
            takes=tuple(
                schemas.PendingDeletion(recording_id=take.recording_id, deletion=key)
                for take, key in found
                if key is not None
            ),
            operators=tuple(name for name in body.operators if records.has_operator(name)),
        )

    @router.post("/confirm", dependencies=[MAY_WRITE])
    @takes({JSON: MAX_CHECK_BYTES})
    def confirm_deletions(
        removed: Annotated[schemas.ConfirmRemoval, Depends(JsonBody(schemas.ConfirmRemoval))],
        sender: Writer,
    ) -> schemas.DeletionsRevision:
        """Note that a station holds none of the deleted takes, except those that it names."""
        sender.check_station(removed.station)
        held: defaultdict[str, list[str]] = defaultdict(list)
        for one in removed.held:
            held[one.deletion].append(one.recording_id)
        records.confirm(removed.station, revision=removed.revision, held=held)
        logger.info("removal_confirmed", station=removed.station, num_held=len(removed.held))
        return schemas.DeletionsRevision(revision=removed.revision)

    return router


def _deletion_of(records: DeletionRecords, station: str, take: schemas.SpooledTake) -> str | None:
    started = take_start(take.started_at, take.started_t_host_ns)
    for recording_id in take.stored_as or (take.recording_id,):
        covered = records.find(
            TakeFacts(
                recording_id=recording_id,
                station=station,
                started=started,
                operator=take.operator,
                started_at=take.started_at,
                is_damaged=take.is_damaged,
            )
        )
        if covered is not None and not covered.is_later:
            return covered.key
    return None


def deletion_statuses(records: DeletionRecords) -> list[schemas.DeletionStatus]:
    """All deletions, oldest first, with what is outstanding of each."""
    return [
        schemas.DeletionStatus(
            key=key,
            deleted_at=record.deleted_at,
            is_of_operator=record.operator_digest is not None,
            num_recordings=len(record.takes),
            outstanding=records.outstanding(key),
        )
        for key, record in records.read().items()
    ]
