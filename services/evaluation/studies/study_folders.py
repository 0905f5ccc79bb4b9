"""The studies in a folder, read again when their results change."""

import re
import threading
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from dextouch.errors import CorruptDataError, DexTouchError, NotFoundError
from dextouch.schemas import first_problems
from services.evaluation.scores import RolloutFailure
from services.evaluation.studies.definition import NAME_PATTERN, StudyDefinition
from services.evaluation.studies.results import FILE, StudyResults
from services.evaluation.studies.study_figures import (
    StudyFigures,
    StudyRollout,
    StudySummary,
    study_figures,
    study_rollouts,
)

MAX_STUDIES: Final = 200
# While a study runs, reading it takes at most this share of the time.
MAX_READING_SHARE: Final = 0.1


@dataclass
class _Study:
    """Results of a study as they were at one moment; figures are computed when asked for."""

    name: str
    definition: StudyDefinition
    results: StudyResults
    changed_at: datetime

    @property
    def summary(self) -> StudySummary:
        outcomes = self.results.outcomes.values()
        return StudySummary(
            name=self.name,
            title=self.definition.name,
            tasks=self.definition.tasks,
            worlds=tuple(self.definition.imagined),
            policies=tuple(self.definition.policies),
            num_rollouts=self.definition.num_rollouts,
            num_done=len(outcomes),
            num_failed=sum(isinstance(one, RolloutFailure) for one in outcomes),
            changed_at=self.changed_at,
        )

    @cached_property
    def rollouts(self) -> tuple[StudyRollout, ...]:
        return study_rollouts(self.definition, self.results)

    @cached_property
    def figures(self) -> StudyFigures:
        return study_figures(self.definition, self.results, self.rollouts, self.summary)


@dataclass
class _Read:
    """What was read last, from which version of the file, and how long it took."""

    version: tuple[int, int]
    study: _Study
    until_s: float
    took_s: float


class StudyFolders:
    """Studies in the subfolders of a folder.

    Args:
        root: folder that holds a folder for each study.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._reads: dict[str, _Read] = {}
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
        """Figures of a study.

        Raises:
            NotFoundError: no such study.
            CorruptDataError: its results are damaged.
        """
        with self._lock:
            study = self._read(name)
            if "figures" not in vars(study):
                began_s, read = time.monotonic(), self._reads[name]
                _ = study.figures
                read.took_s += time.monotonic() - began_s
                read.until_s = time.monotonic() + read.took_s / MAX_READING_SHARE
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
        last = self._reads.get(name)
        if last is not None and last.version == version:
            return last.study
        if last is not None and began_s < last.until_s and StudyResults.is_running(path.parent):
            return last.study
        results = StudyResults.read(path.parent)
        try:
            definition = StudyDefinition.model_validate(results.header.definition)
        except ValidationError as error:
            raise CorruptDataError(
                f"study {name!r}: its definition is not one of this version "
                f"({first_problems(error)})"
            ) from error
        changed_at = datetime.fromtimestamp(status.st_mtime, UTC)
        study = _Study(name, definition, results, changed_at)
        took_s = time.monotonic() - began_s
        until_s = began_s + took_s + took_s / MAX_READING_SHARE
        self._reads[name] = _Read(version, study, until_s, took_s)
        return study
