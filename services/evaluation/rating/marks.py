"""Marks that raters gave to rollouts, kept in an append-only SQLite file."""

import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from dextouch.errors import StorageError
from dextouch.frozen_model import FrozenModel

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
            StoredMark(number, datetime.fromisoformat(at), Mark.model_validate_json(text))
            for number, at, text in rows
        ]

    def latest(self) -> list[StoredMark]:
        """The mark that counts of every rater, kind, episode and presentation, oldest first."""
        newest: dict[tuple[str, str, str, int], StoredMark] = {}
        for stored in self.history():
            mark = stored.mark
            newest[mark.rater, mark.kind, mark.episode_id, mark.presentation] = stored
        return list(newest.values())

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
