"""A folder of episodes and recordings: open, list, write and delete them by id."""

import fcntl
import os
import shutil
import uuid
from pathlib import Path
from urllib.parse import unquote, urlsplit

from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import COMMIT_FILE, KINDS, Kind, check_id
from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.writer import Attributes, EpisodeWriter, attributes_id
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas.episodes import EpisodeAttributes
from dextouch.schemas.recordings import RecordingAttributes

_STAGING = ".staging"


def local_folder(url: str | Path) -> Path:
    """The folder that a store's address names.

    Args:
        url: a path, or `file:///…`.

    Raises:
        InvalidInputError: an address of another scheme, or of another host.
    """
    if isinstance(url, Path):
        return url
    parts = urlsplit(url)
    if not parts.scheme and url:
        return Path(url)
    if parts.scheme == "file" and parts.netloc in {"", "localhost"} and parts.path:
        return Path(unquote(parts.path))
    raise InvalidInputError(
        f"episode store: got {url!r}, expected a local folder or file:///…; "
        "other kinds of storage are not supported yet"
    )


class EpisodeStore:
    """All episodes and recordings below one folder.

    Reading and writing from several processes at once is safe: what is committed never changes,
    and what is not committed is not seen.

    Args:
        url: local folder or `file:///…`; created when the first thing is written.
    """

    def __init__(self, url: str | Path) -> None:
        self.root = local_folder(url)

    def writer(self, *, kind: Kind = "episode", attributes: Attributes) -> EpisodeWriter:
        """A context manager that writes one episode or recording.

        Raises:
            ConflictError: the id exists already.
            InvalidInputError: attributes of the other kind.
        """
        if kind not in KINDS:
            raise UnknownNameError("kind", kind, list(KINDS))
        model = EpisodeAttributes if kind == "episode" else RecordingAttributes
        if not isinstance(attributes, model):
            raise InvalidInputError(
                f"writer: got {type(attributes).__name__}, expected {model.__name__} for {kind!r}"
            )
        target = self._folder(kind, attributes_id(attributes))
        if target.exists():
            raise ConflictError(f"{kind} {target.name!r} exists already; choose another id")
        stage = self.root / _STAGING / f"{kind}-{target.name}-{uuid.uuid4().hex}"
        return EpisodeWriter(stage=stage, target=target, kind=kind, attributes=attributes)

    def open(self, episode_id: str) -> EpisodeReader:
        """The reader of a committed episode.

        Raises:
            NotFoundError: no such episode.
            CorruptDataError, StorageError: damaged, or of a newer format.
        """
        return EpisodeReader(self._existing("episode", episode_id))

    def recording(self, recording_id: str) -> RecordingReader:
        """The reader of a finished recording; raises as `open`."""
        return RecordingReader(self._existing("recording", recording_id))

    def exists(self, item_id: str, *, kind: Kind = "episode") -> bool:
        """Whether an id is committed."""
        return (self._folder(kind, item_id) / COMMIT_FILE).is_file()

    def revision(self, item_id: str, *, kind: Kind = "episode") -> int:
        """A number that changes when an id is deleted and written again.

        Raises:
            NotFoundError: no such id.
        """
        with disk_errors(f"look at {kind} {item_id}"):
            return (self._existing(kind, item_id) / COMMIT_FILE).stat().st_mtime_ns

    def list(self, *, kind: Kind = "episode") -> list[str]:
        """Committed ids in order."""
        if kind not in KINDS:
            raise UnknownNameError("kind", kind, list(KINDS))
        folder = self.root / f"{kind}s"
        with disk_errors(f"list {kind}s"):
            if not folder.is_dir():
                return []
            return sorted(path.name for path in folder.iterdir() if (path / COMMIT_FILE).is_file())

    def delete(self, item_id: str, *, kind: Kind = "episode") -> None:
        """Remove an episode or recording; it vanishes at once, its bytes a moment later.

        Raises:
            NotFoundError: no such id.
        """
        folder = self._existing(kind, item_id)
        trash = self.root / _STAGING / f"deleted-{item_id}-{uuid.uuid4().hex}"
        with disk_errors(f"delete {kind} {item_id}"):
            trash.parent.mkdir(parents=True, exist_ok=True)
            folder.rename(trash)
            shutil.rmtree(trash)

    def sweep(self) -> int:
        """Remove what crashed writers left behind; the number of removed stages comes back."""
        staging = self.root / _STAGING
        removed = 0
        with disk_errors("sweep"):
            for stage in sorted(staging.iterdir()) if staging.is_dir() else []:
                descriptor = os.open(stage, os.O_RDONLY)
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    continue
                else:
                    shutil.rmtree(stage)
                    removed += 1
                finally:
                    os.close(descriptor)
        return removed

    def _folder(self, kind: Kind, item_id: str) -> Path:
        if kind not in KINDS:
            raise UnknownNameError("kind", kind, list(KINDS))
        return self.root / f"{kind}s" / check_id(item_id, kind=f"{kind} id")

    def _existing(self, kind: Kind, item_id: str) -> Path:
        folder = self._folder(kind, item_id)
        if not (folder / COMMIT_FILE).is_file():
            raise NotFoundError(f"{kind} {item_id!r}: not in the store {self.root}")
        return folder
