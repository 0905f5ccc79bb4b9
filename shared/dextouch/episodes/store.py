"""A folder of episodes and recordings: open, list, write and delete them by id."""

import fcntl
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

from dextouch.episodes.files import disk_errors, sync_folder
from dextouch.episodes.format import COMMIT_FILE, KINDS, Kind, check_id
from dextouch.episodes.group_contents import read_group, read_live
from dextouch.episodes.migration import OldGroup, is_current
from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.sources import LocalGroup
from dextouch.episodes.stage import Attributes, attributes_id
from dextouch.episodes.stage_recovery import RecoveredGroup, is_recoverable, recover_stage
from dextouch.episodes.write_options import WriteOptions
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas.episodes import EpisodeAttributes
from dextouch.schemas.recordings import RecordingAttributes

_STAGING = ".staging"
# Names of stages end in a uuid4 in hexadecimal.
_STAGE_NUMBER = "[0-9a-f]" * 32


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

    def writer(
        self,
        *,
        kind: Kind = "episode",
        attributes: Attributes,
        options: WriteOptions | None = None,
    ) -> EpisodeWriter:
        """A context manager that writes one episode or recording.

        Args:
            kind: of the group.
            attributes: of that kind.
            options: durability, speed and quality of video; None for the defaults.

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
        return EpisodeWriter(
            stage=stage, target=target, attributes=attributes, options=options or WriteOptions()
        )

    def open(self, episode_id: str) -> EpisodeReader:
        """The reader of a committed episode.

        Raises:
            NotFoundError: no such episode.
            CorruptDataError, StorageError: damaged, or of a newer format.
        """
        group = LocalGroup(self._existing("episode", episode_id))
        return EpisodeReader(read_group(group, "episode", EpisodeAttributes))

    def recording(self, recording_id: str) -> RecordingReader:
        """The reader of a finished recording; raises as `open`."""
        group = LocalGroup(self._existing("recording", recording_id))
        return RecordingReader(read_group(group, "recording", RecordingAttributes))

    def live(self, recording_id: str) -> RecordingReader:
        """A reader of what an unfinished recording holds at this moment; ask again for more.

        Raises:
            NotFoundError: no writer is at work under this id.
        """
        stages = sorted(
            (self.root / _STAGING).glob(f"recording-{check_id(recording_id)}-{_STAGE_NUMBER}")
        )
        if not stages:
            raise NotFoundError(f"recording {recording_id!r}: is not being written")
        return RecordingReader(read_live(stages[-1], "recording", RecordingAttributes))

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

    def migrate(self, item_id: str, *, kind: Kind = "episode") -> bool:
        """Bring a group of an older format version over; False if it is of the current one.

        The new group takes the old one's place in one moment; its lineage names the old content.

        Raises:
            NotFoundError: no such id.
            CorruptDataError: damaged; it stays as it is.
            StorageError: of a newer version.
        """
        folder = self._existing(kind, item_id)
        files = LocalGroup(folder)
        if is_current(files, what=f"{kind} {item_id}"):
            return False
        old = OldGroup(files, kind)
        staging, number = self.root / _STAGING, uuid.uuid4().hex
        # Committed beside the store first: a kill between the two renames below is mended by
        # `recover`, which finds a whole group whose place is free.
        whole = staging / f"migrated-{item_id}-{number}"
        with EpisodeWriter(
            stage=staging / f"{kind}-{item_id}-{number}",
            target=whole,
            attributes=old.attributes,
            options=WriteOptions(recoverable=False),
        ) as writer:
            for stream in old.attributes.streams:
                for values, stamps in old.blocks(stream):
                    writer.append(stream.name, values=values, **stamps)
        trash = staging / f"old-{item_id}-{number}"
        with disk_errors(f"migrate {item_id}"):
            folder.rename(trash)
            whole.rename(folder)
            sync_folder(folder.parent)
            shutil.rmtree(trash)
        return True

    def recover(self) -> tuple[RecoveredGroup, ...]:
        """Complete the recordings that killed writers left behind, as far as they went.

        Each is there afterwards with `recovered` set, cut to its last whole storage chunks. Stages
        with nothing worth keeping stay for `sweep`, and those of running writers are not touched.

        Raises:
            CorruptDataError: damage that is no torn end; that stage is as it was.
        """
        recovered = []
        for stage in self._abandoned_stages():
            group = recover_stage(stage, self.root)
            if group is not None:
                recovered.append(group)
        return tuple(recovered)

    def sweep(self) -> int:
        """Remove what crashed writers left behind; the number of removed stages comes back.

        Recordings that `recover` can complete stay until it did.
        """
        removed = 0
        with disk_errors("sweep"):
            for stage in self._abandoned_stages():
                if not is_recoverable(stage, self.root):
                    shutil.rmtree(stage)
                    removed += 1
        return removed

    def _abandoned_stages(self) -> Iterator[Path]:
        """Stages that no writer holds, each held while the caller looks at it."""
        staging = self.root / _STAGING
        for stage in sorted(staging.iterdir()) if staging.is_dir() else []:
            descriptor = os.open(stage, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            else:
                yield stage
            finally:
                os.close(descriptor)

    def _folder(self, kind: Kind, item_id: str) -> Path:
        if kind not in KINDS:
            raise UnknownNameError("kind", kind, list(KINDS))
        return self.root / f"{kind}s" / check_id(item_id, kind=f"{kind} id")

    def _existing(self, kind: Kind, item_id: str) -> Path:
        folder = self._folder(kind, item_id)
        if not (folder / COMMIT_FILE).is_file():
            raise NotFoundError(f"{kind} {item_id!r}: not in the store {self.root}")
        return folder
