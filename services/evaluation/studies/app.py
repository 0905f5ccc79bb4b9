"""Read-only HTTP service of the studies in a folder, read again when their results change."""

import re
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Final
from urllib.parse import quote

from fastapi import APIRouter, Depends, FastAPI, Query, Response
from pydantic import Field

from dextouch.errors import DexTouchError, NotFoundError
from dextouch.frozen_model import FrozenModel
from dextouch.serving import RequireScope, ServedFolder, create_service_app, serve
from services.evaluation.reporting.policy_picture import Format
from services.evaluation.settings import StudyServiceSettings
from services.evaluation.studies.results import FILE, NAME_PATTERN, StudyResults
from services.evaluation.studies.study_figures import (
    StudyFigures,
    StudyRollout,
    StudySummary,
    picture,
    picture_name,
    study_figures,
    study_rollouts,
    study_summary,
)

SCOPE: Final = "study_read"
PICTURE_TYPES: Final = {"svg": "image/svg+xml", "png": "image/png", "tex": "application/x-tex"}
MAX_PAGE: Final = 500  # chosen: a few hundred bytes each
MAX_STUDIES: Final = 200  # chosen: more than people look through
# While a study runs, reading it takes at most this share of the time.
MAX_READING_SHARE: Final = 0.1


@dataclass
class _Study:
    """A study as it was read last; figures are computed when asked for.

    `version` is that of its file; while the study runs, it is not read again before `until_s`.
    """

    name: str
    version: tuple[int, int]
    results: StudyResults
    changed_at: datetime
    took_s: float = 0.0
    until_s: float = 0.0

    def took(self, seconds: float) -> None:
        """Count time that reading took, and wait for a multiple of it."""
        self.took_s += seconds
        self.until_s = time.monotonic() + self.took_s / MAX_READING_SHARE

    @property
    def summary(self) -> StudySummary:
        return study_summary(self.name, self.results, self.changed_at)

    @cached_property
    def rollouts(self) -> tuple[StudyRollout, ...]:
        return study_rollouts(self.results)

    @cached_property
    def figures(self) -> StudyFigures:
        return study_figures(self.results, self.rollouts, self.summary)


class StudyFolders:
    """Studies in the subfolders of a folder."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._studies: dict[str, _Study] = {}
        self._lock = threading.Lock()

    def summaries(self) -> list[StudySummary]:
        """The studies, those with the newest results first, at most `MAX_STUDIES`."""
        files = [
            (path.stat().st_mtime, path)
            for path in self._root.glob(f"*/{FILE}")
            if re.fullmatch(NAME_PATTERN, path.parent.name)
        ]
        newest = sorted(files, key=lambda file: -file[0])[:MAX_STUDIES]
        return [self._summary(path.parent.name) for _, path in newest]

    def figures(self, name: str) -> StudyFigures:
        """Figures of a study; raises NotFoundError if there is none, or as `StudyResults.read`."""
        with self._lock:
            study = self._read(name)
            if "figures" not in vars(study):
                began_s = time.monotonic()
                _ = study.figures
                study.took(time.monotonic() - began_s)
            figures = study.figures
        running = {"is_running": StudyResults.is_running(self._root / name)}
        summary = figures.summary.model_copy(update=running)
        return figures.model_copy(update={"summary": summary})

    def rollouts(self, name: str) -> tuple[StudyRollout, ...]:
        """Rollouts of a study, disagreements first; raises as `figures`."""
        with self._lock:
            return self._read(name).rollouts

    def _summary(self, name: str) -> StudySummary:
        folder = self._root / name
        try:
            with self._lock:
                summary = self._read(name).summary
            running = {"is_running": StudyResults.is_running(folder)}
            return summary.model_copy(update=running)
        except DexTouchError as error:
            changed_at = datetime.fromtimestamp(folder.stat().st_mtime, UTC)
            return StudySummary(name=name, changed_at=changed_at, problem=error.message)

    def _read(self, name: str) -> _Study:
        path = self._root / name / FILE
        if not re.fullmatch(NAME_PATTERN, name) or not path.is_file():
            raise NotFoundError(
                f"study {name!r}: no results in {self._root}; GET /v1/studies lists them", got=name
            )
        status = path.stat()
        version = (status.st_mtime_ns, status.st_size)
        began_s = time.monotonic()
        last = self._studies.get(name)
        if last is not None:
            must_wait = began_s < last.until_s and StudyResults.is_running(path.parent)
            # Results only grow: fewer bytes are another run in the same folder.
            if last.version == version or (must_wait and last.version[1] <= version[1]):
                return last
        results = StudyResults.read(path.parent)
        changed_at = datetime.fromtimestamp(status.st_mtime, UTC)
        study = _Study(name, version, results, changed_at)
        study.took(time.monotonic() - began_s)
        self._studies[name] = study
        return study


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
        names = ("world", "task", "policy")
        is_named = all(getattr(self, name) in (None, getattr(rollout, name)) for name in names)
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
    def list_studies() -> StudyList:
        """List the studies, those with the newest results first."""
        return StudyList(studies=tuple(folders.summaries()))

    @router.get("/{name}")
    def get_study(name: str) -> StudyFigures:
        """Success rates, agreement and progress of a study."""
        return folders.figures(name)

    @router.get("/{name}/picture", response_class=Response)
    def get_study_picture(
        name: str,
        world: Annotated[str, Query(max_length=64)],
        task: Annotated[str, Query(max_length=64)] = "",
        form: Format = "svg",
    ) -> Response:
        """Imagined over real success of every policy, of one task or of all, for a paper."""
        content = picture(folders.figures(name), world, task, form)
        file_name = quote(picture_name(world, task, form))
        headers = {"content-disposition": f"attachment; filename*=UTF-8''{file_name}"}
        return Response(content, headers=headers, media_type=PICTURE_TYPES[form])

    @router.get("/{name}/rollouts")
    def list_study_rollouts(name: str, query: Annotated[RolloutQuery, Query()]) -> StudyRolloutList:
        """List rollouts of a study that have a result."""
        found = [one for one in folders.rollouts(name) if query.matches(one)]
        page = found[query.offset : query.offset + query.limit]
        return StudyRolloutList(rollouts=tuple(page), num_matching=len(found))

    return router


def main(argv: Sequence[str]) -> int:
    """Serve studies until SIGINT or SIGTERM."""
    return serve("studies", StudyServiceSettings, create_app, argv)
