"""Storage backend in an S3 bucket: groups are written locally and uploaded on commit."""

import builtins
import hashlib
import shutil
import uuid
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from dextouch.episodes.files import disk_errors, write_file
from dextouch.episodes.format import (
    COMMIT_FILE,
    KINDS,
    Attributes,
    Kind,
    attributes_id,
    decode_commit,
)
from dextouch.episodes.migration import is_current
from dextouch.episodes.object_address import parse_address
from dextouch.episodes.object_bucket import Bucket, ObjectFacts
from dextouch.episodes.object_files import ObjectGroup
from dextouch.episodes.staged_group import (
    abandoned_stages,
    new_stage,
    read_committed,
    unheld_folders,
    write_stage,
)
from dextouch.episodes.staging_recovery import (
    RecoveredGroup,
    raise_first,
    recover_all,
    recover_stage,
    samples_of,
    sweep_stages,
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
    """Open `s3://bucket/prefix?options` without contacting the service.

    Raises:
        InvalidInputError, UnknownNameError: an invalid address or option.
    """
    return ObjectStorage(Bucket(parse_address(url, storage_options, work_folder)))


class UploadingWriter(EpisodeWriter):
    """Writes a group to the outbox in the work folder and uploads it on commit.

    After an interrupted upload the group stays in the outbox, from where `recover` uploads it.
    """

    upload: Callable[[], None]
    complete: Callable[[Path], RecoveredGroup | None]

    def _commit(self) -> None:
        super()._commit()
        # The stage's lock is still held, so a concurrent `recover` skips it.
        try:
            self.upload()
        except ConflictError:
            # Back among the stages, where recovery gives it another id or removes it.
            with disk_errors(f"move {self._target}"):
                self._target.rename(self._stage)
            raise

    def _complete(self) -> RecoveredGroup | None:
        # Groups that could not be uploaded stay in the outbox.
        return self.complete(self._stage) if self._stage.exists() else None


class ObjectStorage:
    """Stores committed groups under the keys `episodes/ID/…` and `recordings/ID/…` of a bucket."""

    def __init__(self, bucket: Bucket) -> None:
        self._bucket, self._address = bucket, bucket.address
        self.root = self._address.work_folder
        self._outbox = self.root / _OUTBOX

    def writer(self, kind: Kind, attributes: Attributes, options: WriteOptions) -> EpisodeWriter:
        """Writer of a new group.

        Raises:
            ConflictError: the id exists already, or its upload is pending.
            InvalidInputError: the work folder belongs to another address.
            StorageError, UnavailableError: the bucket cannot be reached; nothing was written.
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
        stage = new_stage(self.root, kind, item_id)
        writer = UploadingWriter(stage=stage, target=target, attributes=attributes, options=options)
        writer.upload = lambda: self._upload(kind, target)
        writer.complete = self._complete
        return writer

    def group(self, kind: Kind, item_id: str) -> ObjectGroup:
        """Files of a committed group."""
        folder = group_key(kind, item_id)
        commit = self._bucket.get(f"{folder}/{COMMIT_FILE}")
        if commit is None:
            raise self._missing(kind, item_id)
        return ObjectGroup(self._bucket, folder, {COMMIT_FILE: commit})

    def exists(self, kind: Kind, item_id: str) -> bool:
        """Whether an id is committed."""
        return self._commit_facts(kind, item_id) is not None

    def revision(self, kind: Kind, item_id: str) -> int:
        """A 63-bit hash of the commit record's entity tag and modification time."""
        facts = self._commit_facts(kind, item_id)
        if facts is None:
            raise self._missing(kind, item_id)
        text = f"{facts.etag} {facts.modified.isoformat()}"
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1

    def num_bytes(self, kind: Kind, item_id: str) -> int:
        """Size of a committed group in the bucket."""
        if not self.exists(kind, item_id):
            raise self._missing(kind, item_id)
        return sum(facts.size for facts in self._bucket.list(group_key(kind, item_id)))

    def list(self, kind: Kind) -> list[str]:
        """Sorted committed ids; takes one request per 1000 objects in the bucket."""
        keys = (facts.key.split("/") for facts in self._bucket.list(f"{kind}s"))
        return sorted(parts[1] for parts in keys if len(parts) == 3 and parts[2] == COMMIT_FILE)

    def delete(self, kind: Kind, item_id: str) -> None:
        """Delete a group: its commit record first, then its other objects."""
        delete_group(self._bucket, kind, item_id)

    def migrate(self, kind: Kind, item_id: str) -> bool:
        """Refuse a group of an older version: keys cannot be replaced atomically."""
        if is_current(self.group(kind, item_id), what=f"{kind} {item_id}"):
            return False
        raise StorageError(
            f"{kind} {item_id!r}: has an older version, which cannot be migrated in "
            f"{self._address}; copy it to a local store, migrate it there and write it here again"
        )

    def recover(self) -> builtins.list[RecoveredGroup]:
        """Commit the stages of terminated writers, and complete interrupted uploads.

        Raises:
            StorageError, UnavailableError: the bucket cannot be reached; try again later.
        """
        if not self.root.is_dir():
            return []
        self._own_work_folder()
        _, failures = recover_all(abandoned_stages(self.root), self._recover_stage)
        found: builtins.list[RecoveredGroup] = []
        for kind in KINDS:
            waiting = unheld_folders(self._outbox / f"{kind}s")
            uploaded, failed = recover_all(waiting, partial(self._deliver, kind))
            found += uploaded
            failures += failed
        raise_first(failures, found)
        return found

    def sweep(self) -> int:
        """Remove stages that cannot be recovered, and objects of abandoned uploads."""
        with disk_errors("sweep"):
            removed = sweep_stages(self.root, self._is_taken)
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
        """Upload a group that no writer holds; a recording gets another id if its own is taken."""
        if not (folder / COMMIT_FILE).exists():
            # The remainder of a group that was uploaded.
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
                # It can be written again, and its writer is gone.
                shutil.rmtree(folder, ignore_errors=True)
                return None
            stage = new_stage(self.root, kind, folder.name)
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
        """Refuse a work folder of another address, whose groups belong to another bucket."""
        owner, mine = self.root / _OWNER_FILE, self._address.fingerprint.encode()
        with disk_errors(f"use work folder {self.root}"):
            if not owner.is_file():
                self.root.mkdir(parents=True, exist_ok=True)
                partial = self.root / f"{_OWNER_FILE}-{uuid.uuid4().hex}"
                write_file(partial, mine)
                partial.replace(owner)
            elif owner.read_bytes() != mine:
                raise InvalidInputError(
                    f"{self._address}: work folder {self.root} belongs to another address; "
                    "give each its own"
                )

    def _commit_facts(self, kind: Kind, item_id: str) -> ObjectFacts | None:
        return self._bucket.head(f"{group_key(kind, item_id)}/{COMMIT_FILE}")

    def _missing(self, kind: Kind, item_id: str) -> NotFoundError:
        return NotFoundError(f"{kind} {item_id!r}: not in the store {self._address}")
