"""Marks that raters gave to rollouts, kept in an append-only SQLite file."""

import json
import sqlite3
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from dextouch.errors import InvalidInputError, StorageError, UnknownNameError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems

RaterName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
# A rater sees every rollout once, and a few rollouts a second time; a tie of others is shown to one
# more rater, whose mark is kept apart since it would make agreement look worse than it is.
FIRST: Final = 1
REPEAT: Final = 2
DECIDING: Final = 3
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS marks (
  number INTEGER PRIMARY KEY AUTOINCREMENT,
  episode_id TEXT NOT NULL, rater TEXT NOT NULL, kind TEXT NOT NULL,
  presentation INTEGER NOT NULL, rated_at TEXT NOT NULL, content TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS marks_by_rater ON marks (rater);
CREATE TRIGGER IF NOT EXISTS marks_stay BEFORE UPDATE ON marks
BEGIN SELECT RAISE(ABORT, 'marks are never changed'); END;
CREATE TRIGGER IF NOT EXISTS marks_are_kept BEFORE DELETE ON marks
BEGIN SELECT RAISE(ABORT, 'marks are never deleted'); END;
"""
BUNDLED: Final = Path(__file__).with_name("rubrics.toml")
_NAME: Final = r"^[a-z][a-z0-9_]{0,63}$"


class Judgement(FrozenModel):
    """A rater's judgement of a rollout.

    `holds` has an entry for every criterion of the task's rubric, or none if the rater
    `cannot_judge`. `is_inconsistent` is true if anything physically impossible is seen.
    `presentation` is 2 when the rater is shown the rollout again, to measure their consistency, and
    3 when others are tied, so that this mark decides.
    Programs that judge rollouts are raters of the kind "auto".
    """

    rater: RaterName
    holds: dict[str, bool] = Field(default={}, max_length=20)
    is_inconsistent: bool = False
    cannot_judge: bool = False
    comment: str = Field(default="", max_length=2000)
    presentation: Literal[1, 2, 3] = 1
    kind: Literal["human", "auto"] = "human"

    @model_validator(mode="after")
    def _judges_or_not(self) -> "Judgement":
        if self.cannot_judge == bool(self.holds):
            raise ValueError("expected a mark for every criterion, or cannot_judge and no marks")
        return self


class Mark(Judgement):
    """The judgement of one rollout."""

    episode_id: str = Field(min_length=1, max_length=200)


@dataclass(frozen=True)
class StoredMark:
    """A mark with its increasing number and its time."""

    number: int
    rated_at: datetime
    mark: Mark


def by_people(marks: Iterable[Mark]) -> dict[str, list[Mark]]:
    """Marks of people by episode, the first of each, without those of rollouts shown again."""
    found: dict[str, dict[str, Mark]] = {}
    for mark in marks:
        if mark.kind == "human" and mark.presentation != REPEAT:
            found.setdefault(mark.episode_id, {}).setdefault(mark.rater, mark)
    return {episode_id: list(given.values()) for episode_id, given in found.items()}


@dataclass(frozen=True)
class Vote:
    """What most raters of a rollout say; `tied` names what as many affirm as deny.

    `holds` is empty if most cannot judge it, or as many as can.
    """

    holds: Mapping[str, bool]
    is_inconsistent: bool
    tied: tuple[str, ...]


def vote(marks: Sequence[Judgement]) -> Vote:
    """Majority of judgements of one rollout, by criterion; no criterion counts for another."""
    answers: dict[str, list[bool]] = {"cannot_judge": [mark.cannot_judge for mark in marks]}
    judges = [mark for mark in marks if not mark.cannot_judge]
    if 2 * len(judges) > len(marks):
        answers["is_inconsistent"] = [mark.is_inconsistent for mark in judges]
        for name in dict.fromkeys(name for mark in judges for name in mark.holds):
            answers[name] = [mark.holds[name] for mark in judges if name in mark.holds]
    tied = tuple(name for name, given in answers.items() if given and 2 * sum(given) == len(given))
    most = {name: 2 * sum(given) > len(given) for name, given in answers.items()}
    most.pop("cannot_judge")
    return Vote(most, most.pop("is_inconsistent", False), tied)


class MarkLog:
    """Append-only store of marks in an SQLite file; several processes may use one file.

    A mark given again for the same rater, rollout and presentation corrects the earlier one, which
    stays in the file. Raises StorageError if it cannot be opened, or is not a file of marks.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self.connected("opened") as connection:
            connection.executescript(_SCHEMA)

    def add(self, mark: Mark) -> int:
        """Append a mark, durably, and return its number; StorageError if it cannot be written."""
        row = (
            mark.episode_id,
            mark.rater,
            mark.kind,
            mark.presentation,
            datetime.now(UTC).isoformat(timespec="milliseconds"),
            mark.model_dump_json(),
        )
        with self.connected("written") as connection:
            cursor = connection.execute(
                "INSERT INTO marks (episode_id, rater, kind, presentation, rated_at, content) "
                "VALUES (?, ?, ?, ?, ?, ?)",
                row,
            )
            return int(cursor.lastrowid or 0)

    def history(self) -> list[StoredMark]:
        """All marks ever given, oldest first; StorageError if the file cannot be read."""
        with self.connected("read") as connection:
            rows = connection.execute(
                "SELECT number, rated_at, content FROM marks ORDER BY number"
            ).fetchall()
        return [
            StoredMark(number, datetime.fromisoformat(at), Mark.model_validate(json.loads(text)))
            for number, at, text in rows
        ]

    def latest(self) -> Mapping[tuple[str, str, int], StoredMark]:
        """The mark that counts for every (rater, episode id, presentation), oldest first."""
        newest: dict[tuple[str, str, int], StoredMark] = {}
        for stored in self.history():
            mark = stored.mark
            newest[mark.rater, mark.episode_id, mark.presentation] = stored
        return newest

    @contextmanager
    def connected(self, done: str) -> Iterator[sqlite3.Connection]:
        """Connection to the file, durably committed at the end; `done` is what it is for.

        Raises StorageError if the file cannot be used.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with closing(sqlite3.connect(self.path, timeout=10)) as connection, connection:
                connection.execute("PRAGMA journal_mode=WAL")
                connection.execute("PRAGMA synchronous=FULL")
                yield connection
        except (OSError, sqlite3.Error) as error:
            raise StorageError(f"ratings {self.path}: cannot be {done} ({error})") from error


class Criterion(FrozenModel):
    """One statement about a rollout that holds or does not.

    `requires` names criteria without which it gives no points. A `latched` criterion holds if it
    was ever reached, any other only if it holds at the end. `milestone` is the corresponding
    milestone of the twin.
    """

    name: str = Field(pattern=_NAME)
    points: float = Field(gt=0, le=100, allow_inf_nan=False)
    description: FreeText = Field(min_length=1, max_length=500)
    requires: tuple[str, ...] = ()
    latched: bool = True
    milestone: str | None = None


class Rubric(FrozenModel):
    """Criteria of a task, and the points that a physical inconsistency costs an imagined rollout.

    Prerequisites of a criterion come before it.
    """

    criteria: tuple[Criterion, ...] = Field(min_length=1, max_length=20)
    penalty: float = Field(default=0.5, ge=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _is_ordered(self) -> "Rubric":
        known: list[str] = []
        for criterion in self.criteria:
            if criterion.name in known:
                raise ValueError(f"criterion {criterion.name!r} is given twice")
            if missing := [name for name in criterion.requires if name not in known]:
                raise ValueError(
                    f"criterion {criterion.name!r} requires {missing[0]!r}, expected one of the "
                    f"criteria before it ({', '.join(known) or 'none'})"
                )
            known.append(criterion.name)
        return self

    @property
    def max_points(self) -> float:
        """Points of a rollout that meets every criterion."""
        return sum(criterion.points for criterion in self.criteria)

    def score(self, holds: Mapping[str, bool | float], *, is_inconsistent: bool = False) -> float:
        """Score of a rollout in 0 … 1: its points as a share of the maximum.

        `holds` is whether each criterion holds, or with what probability: a criterion is then as
        probable as the least probable one that it requires. What is physically impossible costs the
        penalty once. Raises UnknownNameError for another rubric's criterion, and InvalidInputError
        if one has no mark.
        """
        names = [criterion.name for criterion in self.criteria]
        for name in holds:
            if name not in names:
                raise UnknownNameError("criterion", name, names)
        if missing := [name for name in names if name not in holds]:
            raise InvalidInputError(
                f"marks: no mark for {', '.join(missing)}; expected one for each of "
                f"{', '.join(names)}"
            )
        met: dict[str, float] = {}
        for criterion in self.criteria:
            required = (met[name] for name in criterion.requires)
            met[criterion.name] = min(holds[criterion.name], *required, 1.0)
        points = sum(criterion.points * met[criterion.name] for criterion in self.criteria)
        points -= self.penalty * is_inconsistent
        return min(max(points / self.max_points, 0.0), 1.0)

    def score_by_milestones(self, reached: Mapping[str, float]) -> float | None:
        """Score by whether each milestone was reached, or with what probability.

        None where a criterion has no milestone, or it is unknown whether one was reached.
        """
        known = {
            one.name: reached[one.milestone]
            for one in self.criteria
            if one.milestone is not None and one.milestone in reached
        }
        return self.score(known) if len(known) == len(self.criteria) else None


_RUBRICS: Final = TypeAdapter(dict[str, Rubric])


def read_rubrics(path: Path | None = None) -> dict[str, Rubric]:
    """Rubrics of a TOML file by task; by default the package's: the paper's and the twin's tasks.

    Raises InvalidInputError if it is unreadable, or a table holds no valid rubric.
    """
    path = BUNDLED if path is None else path
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"rubrics {path}: cannot be read ({error})") from error
    try:
        return _RUBRICS.validate_python(tables)
    except ValidationError as error:
        raise InvalidInputError(f"rubrics {path}: {first_problems(error)}") from error


def rubric_of(task: str, rubrics: Mapping[str, Rubric]) -> Rubric:
    """Rubric of a task; raises UnknownNameError if it has none."""
    if task not in rubrics:
        raise UnknownNameError("rubric of task", task, list(rubrics))
    return rubrics[task]
