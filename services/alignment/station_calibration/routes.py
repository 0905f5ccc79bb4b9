"""Routes under /v1/calibration: overview of a station's calibration, and guided runs."""

from typing import Annotated

from fastapi import APIRouter, Depends, Response, status
from starlette.concurrency import run_in_threadpool

from dextouch.errors import NotFoundError
from dextouch.serving import RequireScope
from services.alignment.station_calibration.overview import overview
from services.alignment.station_calibration.runs import CalibrationRuns
from services.alignment.station_calibration.schemas import (
    Answer,
    CalibrationOverview,
    RunRequest,
    RunStatus,
)

SCOPE = "calibrate"


def calibration_router(runs: CalibrationRuns) -> APIRouter:
    """Create the router."""
    router = APIRouter(
        prefix="/v1/calibration", tags=["calibration"], dependencies=[Depends(RequireScope(SCOPE))]
    )

    @router.get("")
    async def everything() -> CalibrationOverview:
        """What is calibrated, how well and for how long, and the next step for each."""
        return await run_in_threadpool(overview, runs.place)

    @router.post("/runs", status_code=status.HTTP_202_ACCEPTED)
    async def start(request: RunRequest) -> RunStatus:
        """Begin a guided run; 409 while another one is on."""
        return await run_in_threadpool(runs.start, request)

    @router.get("/run")
    async def run() -> RunStatus | None:
        """The run that is on, or the last one; null before the first."""
        return runs.status()

    @router.get(
        "/run/image", response_class=Response, responses={200: {"content": {"image/jpeg": {}}}}
    )
    async def image() -> Response:
        """The newest image of a camera run, to which its corners belong."""
        data = runs.present().image
        if not data:
            raise NotFoundError("calibration run: no image yet")
        return Response(data, media_type="image/jpeg")

    @router.post("/run/answer")
    async def answer(answer: Annotated[Answer, ...]) -> RunStatus:
        """Answer the question of the run."""
        return runs.present().answer(answer.text)

    @router.post("/run/finish")
    async def finish() -> RunStatus:
        """Calibrate a camera with the views so far."""
        return runs.present().finish()

    @router.post("/run/cancel")
    async def cancel() -> RunStatus:
        """End the run without a result."""
        return await run_in_threadpool(runs.present().cancel)

    return router
