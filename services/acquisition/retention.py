"""Removal of takes from a station's spool: uploaded long enough ago, or deleted in the store.

A take that the store has not acknowledged is removed only where it was deleted there.
"""

import json
import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import structlog
from pydantic import ValidationError

from dextouch import schemas
from dextouch.episodes import disk_errors, folder_bytes
from dextouch.episodes.spool import LOG_FILE, SpoolReader
from dextouch.errors import AccessDeniedError, DexTouchError, NotFoundError, StorageError
from services.acquisition.settings import Retention

if TYPE_CHECKING:
    from dextouch.clients import EpisodeStoreClient

logger = structlog.get_logger(__name__)

RECORDING_FILE: Final = "recording.json"
UPLOADED_FILE: Final = "uploaded.json"
REFUSED_FILE: Final = "refused.txt"
UPLOAD_STATES: Final = ("waiting", "uploaded", "refused")
# Below it, so that nothing takes an incompletely removed take for one.
_REMOVED: Final = ".removed"
DAY_S: Final = 86_400.0
GIGABYTE: Final = 1e9
# One line of JSON for each take that was removed because it was deleted in the store.
REMOVALS_FILE: Final = "removals.jsonl"


class SpoolRetention:
    """Removes acknowledged takes, the oldest acknowledgement first, and measures the spool."""

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
        kept = []
        for path in spooled_takes(self._spool_root):
            if upload_state(path) == "uploaded":
                with suppress(FileNotFoundError):  # removed meanwhile
                    kept.append(((path / UPLOADED_FILE).stat().st_mtime, path))
        kept.sort(reverse=True)
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
        num_bytes = dict.fromkeys(UPLOAD_STATES, 0)
        for path in spooled_takes(self._spool_root):
            state = upload_state(path)
            num_bytes[state] += self._size(path) if state == "uploaded" else folder_bytes(path)
        return num_bytes

    def _size(self, path: Path) -> int:
        if path.name not in self._sizes:
            self._sizes[path.name] = folder_bytes(path)
        return self._sizes[path.name]


def acknowledgement(path: Path) -> schemas.RecordingStatus | None:
    """What the store answered when it had all of a take; None where it has not, as far as known.

    A note that is damaged, cannot be read or says otherwise does not count: the take is sent again.
    """
    try:
        note = schemas.RecordingStatus.model_validate_json((path / UPLOADED_FILE).read_bytes())
    except (ValidationError, OSError):
        return None
    return note if note.state == "finished" else None


def upload_state(path: Path) -> str:
    """The one of `UPLOAD_STATES` of a take; a running one waits, too."""
    if acknowledgement(path) is not None:
        return "uploaded"
    return "refused" if (path / REFUSED_FILE).exists() else "waiting"


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
        shutil.rmtree(grave, onerror=_unless_gone)


def discard_take(path: Path) -> None:
    """As `remove_take`, with nothing left in the spool."""
    remove_take(path)
    # Another process may be removing a take.
    with suppress(OSError):
        (path.parent / _REMOVED).rmdir()


def _unless_gone(_: object, __: object, problem: tuple[Any, BaseException, Any]) -> None:
    """For removals of what recorder and uploader may remove at the same time."""
    if not isinstance(problem[1], FileNotFoundError):
        raise problem[1]


def empty_removed(spool_root: Path) -> None:
    """Complete removals that were interrupted."""
    folder = spool_root / _REMOVED
    if folder.is_dir():
        with disk_errors(f"empty {folder}"):
            for path in folder.iterdir():
                shutil.rmtree(path, onerror=_unless_gone)


@dataclass(frozen=True)
class OperatorNames:
    """Operators that the station remembers besides those of takes, and how it forgets one."""

    known: Callable[[], Sequence[str]]
    forget: Callable[[str], None]


class DeletedTakes:
    """Asks the store which takes of the spool were deleted, removes them and confirms it.

    The store says by a revision whether there was a deletion, so that the spool is only read then,
    and once after a start. `stored_as` gives the ids under which the store has a take, or would
    have it.
    """

    def __init__(
        self,
        spool_root: Path,
        station: str,
        *,
        stored_as: Callable[[Path, schemas.RecordingAttributes | None], Sequence[str]],
        operators: OperatorNames,
    ) -> None:
        self._spool_root, self._station = spool_root, station
        self._stored_as, self._operators = stored_as, operators
        self._revision: str | None = None
        self._problem: str | None = None

    def remove(self, store: "EpisodeStoreClient") -> list[str]:
        """Remove what was deleted since the last call; ids of what was removed.

        A store that does not answer is asked again by the next call, which a warning says once.
        """
        removed: list[str] = []
        try:
            empty_removed(self._spool_root)
            revision = store.deletions_revision()
            if revision != self._revision:
                # What cannot be removed yet, such as a take that is being recorded, is tried again.
                is_done = self._work_off(store, removed)
                self._revision = revision if is_done else None
            self._problem = None
        except DexTouchError as error:
            if error.message != self._problem:
                logger.warning("fail_deletions", error=error.message)
            self._problem = error.message
        return removed

    def _work_off(self, store: "EpisodeStoreClient", removed: list[str]) -> bool:
        """Remove all deleted takes; whether none of them is left to try again."""
        takes: defaultdict[str, list[schemas.SpooledTake]] = defaultdict(list, {self._station: []})
        for station, take in self._spooled():
            takes[station].append(take)
        confirmed, unknown = [], []
        for station, spooled in takes.items():
            try:
                held, revision = self._remove_of(store, station, spooled, removed)
            except AccessDeniedError:
                # Recorded under an earlier name, of which this key may not ask.
                unknown += [take.recording_id for take in spooled]
                continue
            gone = {*removed, *(one.recording_id for one in held)}
            unknown += [
                take.recording_id
                for take in spooled
                if take.is_damaged and take.recording_id not in gone
            ]
            confirmed.append(
                schemas.ConfirmRemoval(
                    station=station,
                    revision=revision,
                    held=tuple(held[: schemas.MAX_CHECKED_TAKES]),
                )
            )
        if unknown:
            # A take of a deleted operator may be among them: then nothing is confirmed, and the
            # store goes on to list this station as outstanding.
            logger.warning(
                "unknown_takes",
                recording_ids=sorted(unknown),
                advice="damaged, or of another station name, so that the store cannot say whether "
                "they were deleted: restore, send or remove them, then start the station again",
            )
            return True
        for one in confirmed:
            store.confirm_removal(one)
        return not any(one.held for one in confirmed)

    def _remove_of(
        self,
        store: "EpisodeStoreClient",
        station: str,
        spooled: Sequence[schemas.SpooledTake],
        removed: list[str],
    ) -> tuple[list[schemas.PendingDeletion], str]:
        """Remove the deleted takes of a station; those that are held, and the first revision."""
        operators = tuple(self._operators.known())
        held: list[schemas.PendingDeletion] = []
        first_revision: str | None = None
        for start in range(0, max(1, len(spooled)), schemas.MAX_CHECKED_TAKES):
            part = tuple(spooled[start : start + schemas.MAX_CHECKED_TAKES])
            checked = store.check_takes(
                schemas.CheckTakes(station=station, takes=part, operators=operators)
            )
            # A deletion in between makes the confirmation of an earlier revision fail.
            first_revision = first_revision or checked.revision
            for found in checked.takes:
                if self._try_remove(self._spool_root / found.recording_id):
                    removed.append(found.recording_id)
                else:
                    held.append(found)
            for operator in checked.operators:
                self._operators.forget(operator)
        return held, first_revision or ""

    def _try_remove(self, path: Path) -> bool:
        """Remove a take, unless it is being recorded or the disk refuses."""
        try:
            if not SpoolReader(path).closed:
                return False
        except NotFoundError:
            return True  # removed meanwhile
        except StorageError:
            pass  # damaged, and deleted all the same
        try:
            self.remove_take(path, "deleted in the store")
        except StorageError as error:
            logger.warning("fail_remove_deleted", recording_id=path.name, error=error.message)
            return False
        return True

    def remove_take(self, path: Path, why: str) -> None:
        """Remove a take that was deleted in the store, and note it in `REMOVALS_FILE`.

        Raises:
            StorageError: it cannot be removed.
        """
        remove_take(path)
        logger.warning("remove_deleted_take", recording_id=path.name, reason=why)
        line = {"at": datetime.now(UTC).isoformat(), "recording_id": path.name, "reason": why}
        removals = self._spool_root / REMOVALS_FILE
        with disk_errors(f"write {REMOVALS_FILE}"), removals.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def _spooled(self) -> Iterator[tuple[str, schemas.SpooledTake]]:
        """All takes of the spool, with the station that recorded each."""
        for path in spooled_takes(self._spool_root):
            try:
                about = SpoolReader(path).attributes
            except NotFoundError:
                continue
            except StorageError:
                ids = tuple(self._stored_as(path, None))
                damaged = schemas.SpooledTake(
                    recording_id=path.name, stored_as=ids, is_damaged=True
                )
                yield self._station, damaged
                continue
            take = schemas.SpooledTake(
                recording_id=path.name,
                stored_as=tuple(self._stored_as(path, about)),
                operator=about.operator,
                started_at=about.started_at,
                started_t_host_ns=about.started_t_host_ns,
            )
            yield about.station, take
