"""Storage quotas of stations, which count unfinished uploads and finished recordings."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import structlog

from dextouch.episodes import disk_errors, folder_bytes
from dextouch.episodes.spool import read_attributes
from dextouch.errors import NotFoundError, StorageError, StorageFullError
from dextouch.schemas import RecordingAttributes, UploadList, UploadSummary
from services.episode_store.admission import FULL_RETRY_S

logger = structlog.get_logger(__name__)

# Maximum age of the sum of finished recordings; our own commits are counted at once.
REFRESH_S = 1.0


@dataclass
class _Account:
    station: str
    num_bytes: int


class StationQuotas:
    """Disk usage by station, checked against a quota (None: unlimited). Thread-safe.

    Counts the uploads in a folder and what `recordings` says of finished recordings.
    """

    def __init__(
        self,
        folder: Path,
        *,
        recordings: Callable[[], dict[str, int]],
        quota_bytes: int | None,
    ) -> None:
        self._folder, self._recordings, self._quota = folder, recordings, quota_bytes
        self._guard = threading.Lock()
        self._accounts: dict[str, _Account] = {
            path.name: _Account(attributes.station, folder_bytes(path))
            for path, attributes in self._spools()
        }
        self._finished: tuple[float, dict[str, int]] | None = None

    @property
    def num_open(self) -> int:
        """Number of unfinished uploads."""
        return len(self._accounts)

    def begin(self, attributes: RecordingAttributes) -> None:
        """Register a new upload."""
        with self._guard:
            self._accounts.setdefault(attributes.recording_id, _Account(attributes.station, 0))

    def add(self, recording_id: str, num_bytes: int) -> None:
        """Add bytes of an upload."""
        with self._guard:
            if recording_id in self._accounts:
                self._accounts[recording_id].num_bytes += num_bytes

    def end(self, recording_id: str) -> None:
        """Unregister an upload that was finished or dropped."""
        with self._guard:
            self._accounts.pop(recording_id, None)
            self._finished = None

    def bytes_of(self, recording_id: str) -> int:
        """Size of an upload; 0 if unknown."""
        account = self._accounts.get(recording_id)
        return 0 if account is None else account.num_bytes

    def check_upload(self, recording_id: str, num_bytes: int) -> None:
        """Refuse bytes of an upload beyond its station's quota.

        Raises:
            StorageFullError: with `retry_after_s`; nothing was written.
        """
        account = self._accounts.get(recording_id)
        if account is not None:
            self.check_station(account.station, num_bytes)

    def check_station(self, station: str, num_bytes: int) -> None:
        """Refuse bytes beyond a station's quota; raises as `check_upload`."""
        if self._quota is None:
            return
        used = self._used(station)
        if used + num_bytes > self._quota:
            raise StorageFullError(
                f"station {station!r}: {used} bytes are in use and {num_bytes} more were sent, "
                f"allowed are {self._quota}; delete recordings or expire uploads of this station",
                reason="quota",
                got=used + num_bytes,
                expected=self._quota,
                retry_after_s=FULL_RETRY_S,
            )

    def idle(self, *, idle_s: float) -> UploadList:
        """Uploads that have been idle for `idle_s`, by id."""
        found = []
        for path, attributes in self._spools():
            seconds = idle_seconds(path)
            if seconds >= idle_s:
                found.append(
                    UploadSummary(
                        recording_id=path.name,
                        station=attributes.station,
                        task=attributes.task,
                        num_bytes=folder_bytes(path),
                        idle_s=seconds,
                    )
                )
        return UploadList(uploads=tuple(found))

    def _used(self, station: str) -> int:
        now = time.monotonic()
        with self._guard:
            if self._finished is None or now - self._finished[0] > REFRESH_S:
                self._finished = (now, self._recordings())
            return self._finished[1].get(station, 0) + sum(
                account.num_bytes
                for account in self._accounts.values()
                if account.station == station
            )

    def _spools(self) -> list[tuple[Path, RecordingAttributes]]:
        found = []
        with disk_errors("list uploads"):
            paths = sorted(self._folder.iterdir()) if self._folder.is_dir() else []
        # A name with a dot is an upload that is still being created.
        for path in (path for path in paths if "." not in path.name):
            try:
                found.append((path, read_attributes(path)))
            except NotFoundError:
                continue  # no upload, or finished while we were listing
            except StorageError as error:
                logger.warning("damaged_upload", recording_id=path.name, reason=error.message)
        return found


def idle_seconds(path: Path) -> float:
    """Seconds since the last write to an upload's folder."""
    with disk_errors(f"look at upload {path.name}"):
        try:
            newest = max(file.stat().st_mtime for file in [path, *path.iterdir()])
        except FileNotFoundError:
            return 0.0
    return max(0.0, time.time() - newest)
