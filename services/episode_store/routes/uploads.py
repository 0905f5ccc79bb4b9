"""Unfinished uploads over HTTP: which ones nobody goes on with, and an end to them on request."""

from typing import Annotated

from fastapi import APIRouter, Query

from dextouch.schemas.recordings import ExpireUploads, UploadList
from services.episode_store.intake import Intake
from services.episode_store.routes.scopes import MAY_READ, MAY_WRITE


def uploads_router(*, intake: Intake) -> APIRouter:
    """Routes under /v1/uploads."""
    router = APIRouter(prefix="/v1/uploads", tags=["uploads"])

    @router.get("", dependencies=[MAY_READ])
    def listing(idle_s: Annotated[float, Query(ge=0)] = 0.0) -> UploadList:
        """Uploads that are not finished and for which nothing has come for so long."""
        return intake.idle(idle_s=idle_s)

    @router.post("/expire", dependencies=[MAY_WRITE])
    def expire(wanted: ExpireUploads) -> UploadList:
        """Drop such uploads with all that was sent of them; the answer lists them."""
        return intake.expire(wanted)

    return router
