"""Routes of /v1/uploads: list and drop abandoned uploads."""

from typing import Annotated

from fastapi import APIRouter, Query

from dextouch.schemas import ExpireUploads, UploadList
from services.episode_store.intake import Intake
from services.episode_store.routes.scopes import MAY_READ, MAY_WRITE


def uploads_router(*, intake: Intake) -> APIRouter:
    """Create the router."""
    router = APIRouter(prefix="/v1/uploads", tags=["uploads"])

    @router.get("", dependencies=[MAY_READ])
    def listing(idle_s: Annotated[float, Query(ge=0)] = 0.0) -> UploadList:
        """List unfinished uploads that have been idle for `idle_s`."""
        return intake.idle(idle_s=idle_s)

    @router.post("/expire", dependencies=[MAY_WRITE])
    def expire(wanted: ExpireUploads) -> UploadList:
        """Drop such uploads with their data; the response lists them."""
        return intake.expire(wanted)

    return router
