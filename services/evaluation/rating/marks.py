"""Marks that raters gave to rollouts, kept in an append-only SQLite file."""

import json
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from dextouch.errors import StorageError
from dextouch.frozen_model import FrozenModel

RaterName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
# A rater sees every rollout once, and a few rollouts a second time.
FIRST: Final = 1
REPEAT: Final = 2
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
    `presentation` is 2 when the rater is shown the rollout again, to measure their consistency.
    Programs that judge rollouts are raters of the kind "auto".
    """

    rater: RaterName
    holds: dict[str, bool] = Field(default={}, max_length=20)
    is_inconsistent: bool = False
    cannot_judge: bool = False
    comment: str = Field(default="", max_length=2000)
    presentation: Literal[1, 2] = 1
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


class MarkLog:
    """Append-only store of marks; several processes may use one file.

    A mark given again for the same rater, rollout and presentation corrects the earlier one, which
    stays in the file.

    Args:
        path: SQLite file, created with its folder.

    Raises:
        StorageError: the file cannot be opened, or is not a file of marks.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with closing(self._connection()) as connection:
                connection.executescript(_SCHEMA)
        except (OSError, sqlite3.Error) as error:
            raise StorageError(f"ratings {path}: cannot be opened ({error})") from error

    def add(self, mark: Mark) -> int:
        """Append a mark, durably, and return its number.

        Raises:
            StorageError: it cannot be written.
        """
        row = (
            mark.episode_id,
            mark.rater,
            mark.kind,
            mark.presentation,
            datetime.now(UTC).isoformat(timespec="milliseconds"),
            mark.model_dump_json(),
        )
        try:
            with closing(self._connection()) as connection, connection:
                cursor = connection.execute(
                    "INSERT INTO marks (episode_id, rater, kind, presentation, rated_at, content) "
                    "VALUES (?, ?, ?, ?, ?, ?)",
                    row,
                )
                return int(cursor.lastrowid or 0)
        except sqlite3.Error as error:
            raise StorageError(f"ratings {self.path}: cannot be written ({error})") from error

    def history(self) -> list[StoredMark]:
        """All marks ever given, oldest first.

        Raises:
            StorageError: the file cannot be read.
        """
        try:
            with closing(self._connection()) as connection:
                rows = connection.execute(
                    "SELECT number, rated_at, content FROM marks ORDER BY number"
                ).fetchall()
        except sqlite3.Error as error:
            raise StorageError(f"ratings {self.path}: cannot be read ({error})") from error
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

    def _connection(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path, timeout=10)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        return connection
