"""Groups in a bucket (S3 API): written in a work folder, then uploaded, the commit record last."""

import builtins
import hashlib
import shutil
import uuid
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from dextouch.episodes.files import disk_errors, write_file
from dextouch.episodes.format import COMMIT_FILE, KINDS, Kind, decode_commit
from dextouch.episodes.migration import is_current
from dextouch.episodes.object_address import ObjectAddress, parse_address
from dextouch.episodes.object_bucket import Bucket
from dextouch.episodes.object_files import CachedBucket, ObjectGroup
from dextouch.episodes.staged_group import Attributes, attributes_id, read_committed, write_stage
from dextouch.episodes.staging import abandoned_stages, new_stage, sweep_stages, unheld_folders
from dextouch.episodes.staging_recovery import (
    RecoveredGroup,
    raise_first,
    recover_all,
    recover_stage,
    samples_of,
)
from dextouch.episodes.uploads import delete_group, group_key, sweep_orphans, upload_group
from dextouch.episodes.write_options import WriteOptions
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    NotFoundError,
    StorageError,
    UnavailableError,
)

_OUTBOX = ".outbox"
_OWNER_FILE = "uploads_to"


def open_object_storage(
    url: str, storage_options: Mapping[str, str], work_folder: str | Path | None
) -> "ObjectStorage":
    """The storage at `s3://bucket/prefix?options`; nothing is asked of the service yet.

    Raises:
        InvalidInputError, UnknownNameError: an address or options that do not fit.
    """
    address = parse_address(url, storage_options, work_folder)
    return ObjectStorage(address, CachedBucket(Bucket(address)))


class UploadingWriter(EpisodeWriter):
    """Writes a group in the work folder; its commit uploads it.

    An interrupt during the upload leaves the group in the outbox, from where `recover` uploads it.

    Args:
        stage: new folder.
        target: in the outbox.
        attributes: of an episode or a recording.
        options: durability and speed.
    """

    upload: Callable[[], None]
    complete: Callable[[Path], RecoveredGroup | None]

    def _commit(self) -> None:
        super()._commit()
        # The lock that came along from the stage is still held: `recover` leaves it to us.
        try:
            self.upload()
        except ConflictError:
            # Back where what is broken off is kept under another id, or removed.
            with disk_errors(f"move {self._target}"):
                self._target.rename(self._stage)
            raise

    def _complete(self) -> RecoveredGroup | None:
        # What could not be uploaded waits in the outbox.
        return self.complete(self._stage) if self._stage.exists() else None


class ObjectStorage:
    """Committed groups as keys `episodes/ID/…` and `recordings/ID/…` of a bucket.

    Args:
        address: of the bucket, with the work folder.
        place: the bucket and its memory.
    """

    def __init__(self, address: ObjectAddress, place: CachedBucket) -> None:
        self._address, self._place, self._bucket = address, place, place.bucket
        self._root = address.work_folder
        self._outbox = self._root / _OUTBOX

    @property
    def root(self) -> Path:
        """The work folder."""
        return self._root

    def writer(self, kind: Kind, attributes: Attributes, options: WriteOptions) -> EpisodeWriter:
        """A writer whose commit puts a group here.

        Raises:
            ConflictError: the id exists already, or waits to be uploaded.
            InvalidInputError: the work folder belongs to another address.
            StorageError, UnavailableError: the bucket cannot be reached; nothing was begun.
        """
        item_id = attributes_id(attributes)
        self._own_work_folder()
        target = self._outbox / f"{kind}s" / item_id
        if target.exists():
            raise ConflictError(
                f"{kind} {item_id!r} waits in {target} to be uploaded; `recover` completes it"
            )
        if self.exists(kind, item_id):
            raise ConflictError(f"{kind} {item_id!r} exists already; choose another id")
        stage = new_stage(self._root, kind, item_id)
        writer = UploadingWriter(stage=stage, target=target, attributes=attributes, options=options)
        writer.upload = lambda: self._upload(kind, target)
        writer.complete = self._complete
        return writer

    def group(self, kind: Kind, item_id: str) -> ObjectGroup:
        """The files of a committed group.

        Raises:
            NotFoundError: no such id.
        """
        folder = group_key(kind, item_id)
        commit = self._bucket.get(f"{folder}/{COMMIT_FILE}")
        if commit is None:
            raise self._missing(kind, item_id)
        return ObjectGroup(self._place, folder, {COMMIT_FILE: commit})

    def exists(self, kind: Kind, item_id: str) -> bool:
        """Whether an id is committed."""
        return self._bucket.head(f"{group_key(kind, item_id)}/{COMMIT_FILE}") is not None

    def revision(self, kind: Kind, item_id: str) -> int:
        """A number of 63 bits from the commit record's entity tag and time.

        Raises:
            NotFoundError: no such id.
        """
        facts = self._bucket.head(f"{group_key(kind, item_id)}/{COMMIT_FILE}")
        if facts is None:
            raise self._missing(kind, item_id)
        text = f"{facts.etag} {facts.modified.isoformat()}"
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1

    def num_bytes(self, kind: Kind, item_id: str) -> int:
        """What a committed group takes in the bucket.

        Raises:
            NotFoundError: no such id.
        """
        if not self.exists(kind, item_id):
            raise self._missing(kind, item_id)
        return sum(facts.size for facts in self._bucket.list(group_key(kind, item_id)))

    def list(self, kind: Kind) -> list[str]:
        """Committed ids in order; one request for every thousand files in the bucket."""
        keys = (facts.key.split("/") for facts in self._bucket.list(f"{kind}s"))
        return sorted(parts[1] for parts in keys if len(parts) == 3 and parts[2] == COMMIT_FILE)

    def delete(self, kind: Kind, item_id: str) -> None:
        """Remove a group; it vanishes at once, its bytes a moment later.

        Raises:
            NotFoundError: no such id.
        """
        if not self.exists(kind, item_id):
            raise self._missing(kind, item_id)
        delete_group(self._bucket, kind, item_id)

    def migrate(self, kind: Kind, item_id: str) -> bool:
        """False for a group of the current version, which all are that were written here.

        Raises:
            StorageError: a copy of an older group: keys cannot be exchanged in one moment.
        """
        if is_current(self.group(kind, item_id), what=f"{kind} {item_id}"):
            return False
        raise StorageError(
            f"{kind} {item_id!r}: is of an older version, which cannot be brought over in "
            f"{self._address}; copy it to a local store, migrate it there and write it here anew"
        )

    def recover(self) -> builtins.list[RecoveredGroup]:
        """Complete what killed writers left behind, and uploads that were cut off.

        Raises:
            CorruptDataError: damage that is no torn end; that stage is as it was, all others are
                completed.
            StorageError, UnavailableError: the bucket cannot be reached; repeat it later.
        """
        if not self._root.is_dir():
            return []
        self._own_work_folder()
        _, failures = recover_all(abandoned_stages(self._root), self._recover_stage)
        found: builtins.list[RecoveredGroup] = []
        for kind in KINDS:
            waiting = unheld_folders(self._outbox / f"{kind}s")
            uploaded, failed = recover_all(waiting, partial(self._deliver, kind))
            found += uploaded
            failures += failed
        raise_first(failures, found)
        return found

    def sweep(self) -> int:
        """Remove stages of which nothing can be made, and files of dead uploads in the bucket."""
        with disk_errors("sweep"):
            removed = sweep_stages(self._root, self._is_taken)
        return removed + sweep_orphans(self._bucket)

    def _upload(self, kind: Kind, folder: Path) -> None:
        try:
            upload_group(self._bucket, kind, folder)
        except (StorageError, UnavailableError) as error:
            raise type(error)(
                f"{error.message}; {kind} {folder.name!r} waits in {folder}, `recover` uploads it"
            ) from error
        except KeyboardInterrupt as interrupt:
            if (folder / COMMIT_FILE).exists():
                interrupt.add_note(
                    f"{kind} {folder.name!r} waits in {folder}, `recover` uploads it"
                )
            raise

    def _deliver(self, kind: Kind, folder: Path) -> RecoveredGroup | None:
        """Upload a group that nobody holds; a recording under another id if its own was taken."""
        if not (folder / COMMIT_FILE).exists():
            # What is left of one that was uploaded.
            with disk_errors(f"remove {folder}"):
                shutil.rmtree(folder)
            return None
        with disk_errors(f"read {folder}"):
            record = decode_commit((folder / COMMIT_FILE).read_bytes(), what=folder.name)[0]
        attributes = read_committed(folder, kind)
        try:
            self._upload(kind, folder)
        except ConflictError:
            if kind == "episode":
                # It can be made again; there is nobody left to be told.
                shutil.rmtree(folder, ignore_errors=True)
                return None
            stage = new_stage(self._root, kind, folder.name)
            write_stage(folder, attributes)
            with disk_errors(f"move {folder}"):
                stage.parent.mkdir(parents=True, exist_ok=True)
                folder.rename(stage)
            return self._complete(stage)
        return RecoveredGroup(kind, folder.name, samples_of(record, attributes))

    def _complete(self, stage: Path) -> RecoveredGroup | None:
        group = self._recover_stage(stage)
        if group is not None:
            self._upload(group.kind, self._outbox / f"{group.kind}s" / group.item_id)
        return group

    def _recover_stage(self, stage: Path) -> RecoveredGroup | None:
        return recover_stage(stage, self._outbox, self._is_taken)

    def _is_taken(self, kind: Kind, item_id: str) -> bool:
        return (self._outbox / f"{kind}s" / item_id).exists() or self.exists(kind, item_id)

    def _own_work_folder(self) -> None:
        """Refuse a work folder whose remains would be uploaded to the wrong place."""
        owner, mine = self._root / _OWNER_FILE, self._address.fingerprint.encode()
        with disk_errors(f"use work folder {self._root}"):
            if not owner.is_file():
                self._root.mkdir(parents=True, exist_ok=True)
                partial = self._root / f"{_OWNER_FILE}-{uuid.uuid4().hex}"
                write_file(partial, mine)
                partial.replace(owner)
            elif owner.read_bytes() != mine:
                raise InvalidInputError(
                    f"{self._address}: work folder {self._root} belongs to another address; "
                    "give each its own"
                )

    def _missing(self, kind: Kind, item_id: str) -> NotFoundError:
        return NotFoundError(f"{kind} {item_id!r}: not in the store {self._address}")
