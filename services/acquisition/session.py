"""Count of the takes that were saved in an operator's session, kept in the spool."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import structlog
from pydantic import ValidationError

from dextouch.episodes import disk_errors, replace_file
from dextouch.errors import StorageError
from dextouch.schemas import RecorderSession, SavedTakes, TakePrompt

logger = structlog.get_logger(__name__)

SESSION_FILE: Final = "session.json"


class SessionCount:
    """The present session; counts survive a restart and the deletion of uploaded takes.

    A session that cannot be written is counted in memory: a take that is saved must stay saved.

    Args:
        spool_root: folder of the takes.
    """

    def __init__(self, spool_root: Path) -> None:
        self._path = spool_root / SESSION_FILE
        self.now = self._read() or RecorderSession(started_at=datetime.now(UTC))

    def begin(self) -> None:
        """Begin a new session, in which nothing was saved yet."""
        fresh = {"started_at": datetime.now(UTC), "saved": ()}
        self._write(self.now.model_copy(update=fresh))

    def add(self, prompt: TakePrompt, recording_id: str, *, incomplete: str = "") -> None:
        """Count a saved take; `incomplete` says why it is, if it is."""
        key = (prompt.task, prompt.operator)
        counts = {(item.task, item.operator): item.num_saved for item in self.now.saved}
        counts[key] = counts.get(key, 0) + 1
        saved = tuple(
            SavedTakes(task=task, operator=operator, num_saved=count)
            for (task, operator), count in counts.items()
        )
        last = {"last_saved": recording_id, "last_incomplete": incomplete}
        self._write(self.now.model_copy(update={"saved": saved, **last}))

    def operators(self) -> tuple[str, ...]:
        """All operators that the counts name."""
        names = {item.operator for item in self.now.saved}
        return tuple(sorted(name for name in names if name is not None))

    def forget(self, operator: str) -> None:
        """Remove an operator's counts."""
        saved = tuple(item for item in self.now.saved if item.operator != operator)
        self._write(self.now.model_copy(update={"saved": saved}))

    def _write(self, session: RecorderSession) -> None:
        self.now = session
        try:
            with disk_errors(f"write {self._path.name}"):
                # In a spool that is gone this fails: only a take may create it.
                replace_file(self._path, session.model_dump_json().encode())
        except StorageError as error:
            logger.warning("fail_session_count", error=error.message)

    def _read(self) -> RecorderSession | None:
        try:
            return RecorderSession.model_validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            logger.warning("fail_session_count", error=str(error))
            return None
