"""The FastAPI application of the alignment service: submit, list, show and cancel jobs."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Annotated

from fastapi import APIRouter, Depends, FastAPI, Query, Response, status

from dextouch.episodes import EpisodeStore
from dextouch.schemas import error_from_problem
from dextouch.serving import (
    JSON,
    KIB,
    JsonBody,
    RequireScope,
    ServedFolder,
    create_service_app,
    serve,
    takes,
)
from services.alignment.job_runner import JobRunner, NewRecordings
from services.alignment.schemas import (
    ENDED,
    MAX_BATCH,
    AlignmentJob,
    AlignmentList,
    AlignmentRequest,
    JobState,
)
from services.alignment.settings import AlignmentSettings
from services.alignment.station_calibration.routes import calibration_router
from services.alignment.station_calibration.runs import CalibrationRuns, StationLocation

SCOPE = "align"
PAGE = 100


def create_app(settings: AlignmentSettings) -> FastAPI:
    """Create the service, which reads recordings from a store and writes episodes to it."""
    store = EpisodeStore(settings.store_url)
    jobs = JobRunner(store, settings)
    key = settings.station_key
    runs = CalibrationRuns(
        StationLocation(
            url=settings.station_url,
            key=None if key is None else key.get_secret_value(),
            folder=settings.calibration_folder,
            spool=settings.station_spool,
            store_url=settings.store_url,
        )
    )

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await jobs.start()
        watch = None
        if settings.align_new:
            watch = asyncio.create_task(NewRecordings(store, jobs).watch(settings.period_s))
        try:
            yield
        finally:
            if watch is not None:
                watch.cancel()
                await asyncio.gather(watch, return_exceptions=True)
            await asyncio.to_thread(runs.close)
            await jobs.close()

    async def readiness() -> Sequence[str]:
        waiting = [] if jobs.is_warm else ["solver"]
        problem = jobs.queue.problem
        return waiting if problem is None else [f"jobs: {problem}", *waiting]

    app = create_service_app(
        name="alignment",
        settings=settings,
        routers=[alignments_router(jobs), calibration_router(runs)],
        lifespan=lifespan,
        readiness=readiness,
        folders=[
            ServedFolder(store.root, "store folder"),
            ServedFolder(jobs.jobs_folder, "folder of alignment jobs"),
        ],
    )
    app.state.registry.register(jobs.metrics.registry)
    return app


def alignments_router(jobs: JobRunner) -> APIRouter:
    """Routes under /v1/alignments."""
    router = APIRouter(
        prefix="/v1/alignments", tags=["alignments"], dependencies=[Depends(RequireScope(SCOPE))]
    )

    @router.post("", status_code=status.HTTP_202_ACCEPTED)
    @takes({JSON: 256 * KIB})
    async def start_alignments(
        request: Annotated[AlignmentRequest, Depends(JsonBody(AlignmentRequest))],
        response: Response,
        wait: bool = Query(default=False),  # noqa: FBT001 - a query parameter
    ) -> AlignmentJob | AlignmentList:
        """Submit recordings for alignment; submitting again returns the same jobs.

        `recording_id` gives one job, `recording_ids` a list of them, all taken or none. With
        `wait=true` the answer comes when all have ended (200); the failure of a single one is then
        the error itself.
        """
        submitted = await jobs.submit(request)
        if wait:
            submitted = tuple([await jobs.wait(job.alignment_id) for job in submitted])
        if all(job.state in ENDED for job in submitted):
            response.status_code = status.HTTP_200_OK
        if request.recording_id is None:
            return AlignmentList(alignments=submitted, num_matching=len(submitted))
        if wait and submitted[0].problem is not None:
            raise error_from_problem(submitted[0].problem)
        return submitted[0]

    @router.get("", responses={404: {}})
    async def list_alignments(
        state: JobState | None = None,
        recording_id: Annotated[tuple[str, ...], Query(max_length=MAX_BATCH)] = (),
        after: str | None = None,
        limit: Annotated[int, Query(ge=1, le=MAX_BATCH)] = PAGE,
    ) -> AlignmentList:
        """Alignments, oldest first, a page at a time; `after` is the last id of the page before.

        A repeated `recording_id` lists only those of these recordings.
        """
        return jobs.queue.page(
            state=state, recording_ids=frozenset(recording_id), after=after, limit=limit
        )

    @router.get("/{alignment_id}")
    async def get_alignment(alignment_id: str) -> AlignmentJob:
        """The state of one alignment."""
        return jobs.queue.get(alignment_id)

    @router.post("/{alignment_id}/cancel")
    async def cancel_alignment(alignment_id: str) -> AlignmentJob:
        """Cancel an alignment that waits or runs; one that is done or failed is a conflict."""
        return await jobs.cancel(alignment_id)

    return router


def main(argv: Sequence[str]) -> int:
    """Serve the alignment service until SIGINT or SIGTERM."""
    return serve("alignment", AlignmentSettings, create_app, argv)
