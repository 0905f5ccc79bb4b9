"""Read-only HTTP service of the results of studies."""

from collections.abc import Sequence
from typing import Annotated, Final

from fastapi import APIRouter, Depends, FastAPI, Query
from pydantic import Field

from dextouch.frozen_model import FrozenModel
from dextouch.serving import (
    RequireScope,
    ServedFolder,
    create_service_app,
    serve,
)
from services.evaluation.studies.settings import StudyServiceSettings
from services.evaluation.studies.study_figures import StudyFigures, StudyRollout, StudySummary
from services.evaluation.studies.study_folders import StudyFolders

SCOPE: Final = "study_read"
MAX_PAGE: Final = 500


class StudyList(FrozenModel):
    """Response of GET /v1/studies."""

    studies: tuple[StudySummary, ...]


class RolloutQuery(FrozenModel):
    """Which rollouts of a study are listed; disagreements with the real world come first."""

    world: str | None = Field(default=None, max_length=64)
    task: str | None = Field(default=None, max_length=64)
    policy: str | None = Field(default=None, max_length=64)
    disagreements: bool = False
    limit: int = Field(default=100, ge=1, le=MAX_PAGE)
    offset: int = Field(default=0, ge=0)

    def matches(self, rollout: StudyRollout) -> bool:
        """Whether a rollout is asked for."""
        pairs = (
            (self.world, rollout.world),
            (self.task, rollout.task),
            (self.policy, rollout.policy),
        )
        is_named = all(wanted is None or wanted == found for wanted, found in pairs)
        return is_named and (rollout.disagrees or not self.disagreements)


class StudyRolloutList(FrozenModel):
    """Response of GET /v1/studies/{name}/rollouts."""

    rollouts: tuple[StudyRollout, ...]
    num_matching: int


def create_app(settings: StudyServiceSettings) -> FastAPI:
    """Create the application."""
    routers = [study_router(StudyFolders(settings.studies))]
    folder = ServedFolder(settings.studies, "folder of studies", is_written=False)
    return create_service_app(name="studies", settings=settings, routers=routers, folders=[folder])


def study_router(folders: StudyFolders) -> APIRouter:
    """Router of studies; its functions run in threads, since figures take seconds."""
    may_read = [Depends(RequireScope(SCOPE))]
    router = APIRouter(prefix="/v1/studies", tags=["studies"], dependencies=may_read)

    @router.get("")
    def studies() -> StudyList:
        """List the studies, those with the newest results first."""
        return StudyList(studies=tuple(folders.summaries()))

    @router.get("/{name}")
    def figures(name: str) -> StudyFigures:
        """Success rates, agreement and progress of a study."""
        return folders.figures(name)

    @router.get("/{name}/rollouts")
    def rollouts(name: str, query: Annotated[RolloutQuery, Query()]) -> StudyRolloutList:
        """List rollouts of a study that have a result."""
        found = [one for one in folders.rollouts(name) if query.matches(one)]
        page = found[query.offset : query.offset + query.limit]
        return StudyRolloutList(rollouts=tuple(page), num_matching=len(found))

    return router


def main(argv: Sequence[str]) -> int:
    """Serve studies until SIGINT or SIGTERM."""
    return serve("studies", StudyServiceSettings, create_app, argv)
