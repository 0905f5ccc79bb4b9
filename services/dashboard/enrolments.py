"""Entries of the audit log for tokens that stations used, which only the episode store sees."""

from http import HTTPStatus
from typing import Final

from dextouch.errors import DexTouchError
from dextouch.schemas import StationEnrolments
from services.dashboard.audit import AuditEntry
from services.dashboard.upstream import Upstream

ACTION: Final = "use enrolment token"


async def used_tokens(store: Upstream | None) -> tuple[list[AuditEntry], str]:
    """Entries of all used tokens, and why they are missing if the store does not list them."""
    if store is None:
        return [], ""
    try:
        listed = await store.read(StationEnrolments, "/v1/enrolments")
    except DexTouchError as error:
        return [], error.message
    entries = [
        AuditEntry(
            at=one.enrolled_at,
            person=f"station {one.station}",
            action=ACTION,
            target=one.station,
            status=HTTPStatus.CREATED,
            client=one.enrolled_from,
        )
        for one in listed.enrolments
        if one.enrolled_at is not None
    ]
    return entries, ""
