"""Alignments over HTTP: start one, see where it stands."""

from fastapi import APIRouter, Depends, Query, Response, status

from dextouch.schemas.problems import error_from_problem
from dextouch.serving.access import RequireScope
from services.alignment.job_table import JobTable
from services.alignment.schemas import AlignmentJob, AlignmentList, AlignmentRequest

SCOPE = "align"


def alignments_router(jobs: JobTable) -> APIRouter:
    """Routes under /v1/alignments."""
    router = APIRouter(
        prefix="/v1/alignments", tags=["alignments"], dependencies=[Depends(RequireScope(SCOPE))]
    )

    @router.post("", status_code=status.HTTP_202_ACCEPTED)
    async def start(
        request: AlignmentRequest,
        response: Response,
        wait: bool = Query(default=False),  # noqa: FBT001 - a query parameter
    ) -> AlignmentJob:
        """Start aligning a recording; asked again, the same alignment answers.

        With `wait=true` the answer comes when it is done (200), and a failure is the error itself.
        """
        job = await jobs.submit(request)
        if wait:
            job = await jobs.wait(job.alignment_id)
            if job.problem is not None:
                raise error_from_problem(job.problem)
        if job.state == "done":
            response.status_code = status.HTTP_200_OK
        return job

    @router.get("")
    async def listing() -> AlignmentList:
        """All alignments that this process knows, oldest first."""
        return AlignmentList(alignments=jobs.all())

    @router.get("/{alignment_id}")
    async def state(alignment_id: str) -> AlignmentJob:
        """Where one alignment stands."""
        return jobs.get(alignment_id)

    return router
