"""Removal of takes from a station's spool: those that the store has had for long enough.

A take that the store has not acknowledged is never removed here.
"""

import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import structlog
from pydantic import Field, ValidationError

from dextouch.episodes import disk_errors, folder_bytes
from dextouch.episodes.spool import LOG_FILE
from dextouch.errors import StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import RecordingStatus

logger = structlog.get_logger(__name__)

RECORDING_FILE: Final = "recording.json"
UPLOADED_FILE: Final = "uploaded.json"
REFUSED_FILE: Final = "refused.txt"
# Below it, so that nothing takes an incompletely removed take for one.
_REMOVED: Final = ".removed"
DAY_S: Final = 86_400.0
GIGABYTE: Final = 1e9


class Retention(FrozenModel):
    """How long takes stay in the spool after the store acknowledged them."""

    keep_uploaded_days: float = Field(
        default=7.0,
        ge=0,
        allow_inf_nan=False,
        description="days that a take stays in the spool after the store acknowledged it",
    )
    keep_uploaded_gb: float | None = Field(
        default=None,
        ge=0,
        allow_inf_nan=False,
        description="GB of acknowledged takes to keep at most, the newest (default: no limit)",
    )


class SpoolRetention:
    """Removes acknowledged takes, the oldest acknowledgement first, and measures the spool.

    Args:
        spool_root: folder of the takes.
        limits: how long they stay.
        now_s: seconds since 1970.
    """

    def __init__(
        self, spool_root: Path, limits: Retention, *, now_s: Callable[[], float] = time.time
    ) -> None:
        self.limits = limits
        self._spool_root, self._now_s = spool_root, now_s
        # An acknowledged take does not change.
        self._sizes: dict[str, int] = {}

    def sweep(self) -> list[str]:
        """Remove what has been kept long enough; returns the ids."""
        empty_removed(self._spool_root)
        kept = sorted(self._acknowledged(), reverse=True)
        oldest_s = self._now_s() - self.limits.keep_uploaded_days * DAY_S
        limit_gb, total, gone = self.limits.keep_uploaded_gb, 0, []
        for acknowledged_s, path in kept:
            if limit_gb is not None:
                total += self._size(path)
            is_beyond = limit_gb is not None and total > limit_gb * GIGABYTE
            if acknowledged_s <= oldest_s or is_beyond:
                gone.append(path)
        # A removal that ends in between leaves the newest.
        for path in reversed(gone):
            remove_take(path)
            self._sizes.pop(path.name, None)
            logger.info("remove_uploaded_take", recording_id=path.name)
        return [path.name for path in gone]

    def use(self) -> dict[str, int]:
        """Bytes of the takes in the spool by state of their upload; a running one waits, too."""
        num_bytes = {"waiting": 0, "uploaded": 0, "refused": 0}
        for path in spooled_takes(self._spool_root):
            if acknowledgement(path) is not None:
                num_bytes["uploaded"] += self._size(path)
            else:
                state = "refused" if (path / REFUSED_FILE).exists() else "waiting"
                num_bytes[state] += folder_bytes(path)
        return num_bytes

    def _acknowledged(self) -> list[tuple[float, Path]]:
        """Acknowledged takes with the time of that."""
        found = []
        for path in spooled_takes(self._spool_root):
            if acknowledgement(path) is not None:
                with suppress(FileNotFoundError):  # removed meanwhile
                    found.append(((path / UPLOADED_FILE).stat().st_mtime, path))
        return found

    def _size(self, path: Path) -> int:
        if path.name not in self._sizes:
            self._sizes[path.name] = folder_bytes(path)
        return self._sizes[path.name]


def acknowledgement(path: Path) -> RecordingStatus | None:
    """What the store answered when it had all of a take; None where it has not, as far as known.

    A note that is damaged or says otherwise does not count: the take is sent again.
    """
    try:
        note = RecordingStatus.model_validate_json((path / UPLOADED_FILE).read_bytes())
    except (ValidationError, FileNotFoundError):
        return None
    return note if note.state == "finished" else None


def spooled_takes(spool_root: Path) -> list[Path]:
    """Folders of the takes in a spool, by name; also those of which only the log is left."""
    found = (spool_root.glob(f"*/{name}") for name in (RECORDING_FILE, LOG_FILE))
    return sorted({path.parent for paths in found for path in paths})


def remove_take(path: Path) -> None:
    """Remove a take from the spool: at once for everybody else, whatever ends this process.

    Raises:
        StorageError: it cannot be removed.
    """
    grave = path.parent / _REMOVED / path.name
    with disk_errors(f"remove take {path.name!r} from the spool"):
        grave.parent.mkdir(exist_ok=True)
        shutil.rmtree(grave, ignore_errors=True)
        path.rename(grave)
        shutil.rmtree(grave)


def empty_removed(spool_root: Path) -> None:
    """Complete removals that were interrupted."""
    folder = spool_root / _REMOVED
    if folder.is_dir():
        with disk_errors(f"empty {folder}"):
            for path in folder.iterdir():
                shutil.rmtree(path)


def sweep_safely(retention: SpoolRetention) -> None:
    """Sweep, and log why it is not possible."""
    try:
        retention.sweep()
    except StorageError as error:
        logger.warning("fail_retention", error=error.message)
