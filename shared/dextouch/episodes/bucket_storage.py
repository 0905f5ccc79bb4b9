"""Storage backend in an S3 bucket: groups are written locally and uploaded on commit.

They are read in ranges, through a cache. Every group in a bucket carries a `claim` from before its
first file until after its last one is deleted: the sha256 of the content that may be there. Writers
of equal content may run concurrently, since their files are equal; all others are refused before
they overwrite anything.
"""

import builtins
import shutil
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import structlog

from dextouch.episodes.files import (
    GroupFingerprint,
    LocalGroup,
    disk_errors,
    unheld_folders,
    write_file,
)
from dextouch.episodes.format import (
    COMMIT_FILE,
    KINDS,
    METADATA_FILE,
    Attributes,
    Kind,
    attributes_id,
    decode_commit,
)
from dextouch.episodes.s3_bucket import Bucket, ObjectFacts, parse_address
from dextouch.episodes.staging import new_stage, sweep_stages
from dextouch.episodes.trash import REMARK_FILES
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import (
    ConflictError,
    DexTouchError,
    InvalidInputError,
    NotFoundError,
    StorageError,
    UnavailableError,
)

logger = structlog.get_logger(__name__)

_OUTBOX = ".outbox"
_OWNER_FILE = "uploads_to"
# Small enough for a window of images, large enough that a request is worth its round trip.
BLOCK_BYTES = 1 << 18
# One request for the end of a file gives its size, the index of its shard, and all of a small one.
TAIL_BYTES = 1 << 16
# Sequential reads get ever larger requests, up to this many blocks.
MAX_READ_AHEAD = 8
_TAIL = -1
CLAIM_FILE = "claim"
# An empty object of each change, which catalogs list instead of all items.
CHANGES = ".changes"
# A hash that no content has, so that nothing is written while a group is deleted.
_DELETING = b"deleting"
# Uploads older than this count as abandoned.
ORPHAN_AGE = timedelta(days=1)
_PARALLEL_REQUESTS = 8
# Listing one group takes a request, listing all of them one per 1000 objects.
_MAX_ONE_BY_ONE = 20
# Named in a line of the log.
_MAX_PLACES = 10


class ObjectFile:
    """One object, read by ranges through the bucket's cache."""

    def __init__(self, bucket: Bucket, key: str) -> None:
        self._bucket, self._key = bucket, key
        # Held during a request: a second reader then finds the first one's blocks in the cache.
        self._guard = threading.Lock()
        self._facts: ObjectFacts | None = None
        self._next_block, self._ahead = -1, 1

    def __reduce__(self) -> tuple[type["ObjectFile"], tuple[Bucket, str]]:
        return ObjectFile, (self._bucket, self._key)

    def size(self) -> int | None:
        """Length in bytes; None if the object does not exist."""
        with self._guard:
            facts = self._look()
        return None if facts is None else facts.size

    def read(self, offset: int, length: int) -> bytes:
        """Bytes offset … offset + length − 1, fewer at the end; raises as `Bucket.read`."""
        with self._guard:
            facts = self._look()
            if facts is None:
                return b""
            stop = min(offset + length, facts.size)
            if stop <= offset:
                return b""
            if self._bucket.cache.capacity == 0:
                return self._bucket.read(facts, offset, stop)
            tail, tail_start = self._known(facts, _TAIL), max(0, facts.size - TAIL_BYTES)
            if tail is not None and offset >= tail_start:
                return tail[offset - tail_start : stop - tail_start]
            return self._from_blocks(facts, offset, stop)

    def _look(self) -> ObjectFacts | None:
        if self._facts is None:
            found = self._bucket.tail(self._key, TAIL_BYTES)
            if found is None:
                return None
            self._facts = found[0]
            self._keep(self._facts, _TAIL, found[1])
        return self._facts

    def _from_blocks(self, facts: ObjectFacts, offset: int, stop: int) -> bytes:
        first, last = offset // BLOCK_BYTES, (stop - 1) // BLOCK_BYTES
        blocks = {n: self._known(facts, n) for n in range(first, last + 1)}
        missing = [number for number, block in blocks.items() if block is None]
        if missing:
            blocks |= self._fetch(facts, missing[0], missing[-1] + 1)
        data = b"".join(blocks[number] or b"" for number in range(first, last + 1))
        return data[offset - first * BLOCK_BYTES : stop - first * BLOCK_BYTES]

    def _fetch(self, facts: ObjectFacts, first: int, stop: int) -> dict[int, bytes]:
        """Blocks first … stop−1 and perhaps some after them, with one request."""
        self._ahead = min(2 * self._ahead, MAX_READ_AHEAD) if first == self._next_block else 1
        num_blocks = -(-facts.size // BLOCK_BYTES)
        stop = min(max(stop, first + self._ahead), num_blocks)
        self._next_block = stop
        start = first * BLOCK_BYTES
        data = self._bucket.read(facts, start, min(stop * BLOCK_BYTES, facts.size))
        blocks = {
            number: data[number * BLOCK_BYTES - start : (number + 1) * BLOCK_BYTES - start]
            for number in range(first, stop)
        }
        for number, block in blocks.items():
            self._keep(facts, number, block)
        return blocks

    def _known(self, facts: ObjectFacts, number: int) -> bytes | None:
        return self._bucket.cache.get((facts.key, facts.etag, number))

    def _keep(self, facts: ObjectFacts, number: int, block: bytes) -> None:
        self._bucket.cache.put((facts.key, facts.etag, number), block)


class ObjectGroup:
    """The files of a committed group in a bucket, below the prefix `episodes/ID`.

    `known` are the contents of files that were read already, by name.
    """

    def __init__(self, bucket: Bucket, folder: str, known: dict[str, bytes]) -> None:
        self._bucket, self._folder, self._known = bucket, folder, known
        self.item_id = folder.rpartition("/")[2]

    def get(self, name: str) -> bytes | None:
        """Contents of a small file; None if it does not exist."""
        if name in self._known:
            return self._known[name]
        return self.get_now(name)

    def get_now(self, name: str) -> bytes | None:
        """As `get`, always from the bucket."""
        return self._bucket.get(f"{self._folder}/{name}")

    def source(self, name: str) -> ObjectFile:
        """A file for range reads."""
        return ObjectFile(self._bucket, f"{self._folder}/{name}")

    def names(self) -> list[str]:
        """Sorted names of all files of the group, with those beside its content."""
        keys = (facts.key for facts in self._bucket.list(self._folder))
        names = (key.removeprefix(f"{self._folder}/") for key in keys)
        return sorted(name for name in names if name != CLAIM_FILE)


class UploadingWriter(EpisodeWriter):
    """Writes a group to the outbox in the work folder and uploads it on commit.

    After an interrupted upload the group stays in the outbox until `complete_uploads` uploads it.
    """

    upload: Callable[[], None]

    def _commit(self) -> None:
        super()._commit()
        # The stage's lock is still held, so a concurrent `complete_uploads` skips it.
        try:
            self.upload()
        except ConflictError:
            # Back among the stages, where it is removed.
            with disk_errors(f"move {self._target}"):
                self._target.rename(self._stage)
            raise


class ObjectStorage:
    """Stores committed groups under the keys `episodes/ID/…` and `recordings/ID/…` of a bucket.

    Opening one does not contact the service; raises as `parse_address`.
    """

    def __init__(self, url: str, storage_options: Mapping[str, str]) -> None:
        self._address = parse_address(url, storage_options)
        self._bucket = Bucket(self._address)
        self.root = self._address.work_folder
        self._outbox = self.root / _OUTBOX

    def writer(self, kind: Kind, attributes: Attributes, *, replaces: bool) -> EpisodeWriter:
        """Writer of a new group.

        Raises ConflictError for an id that exists, InvalidInputError if the work folder belongs to
        another address, StorageError if the bucket refused, and UnavailableError if an earlier
        upload of this id is pending, or the bucket cannot be reached; nothing was written.
        """
        item_id = attributes_id(attributes)
        self._own_work_folder()
        target = self._outbox / f"{kind}s" / item_id
        if target.exists():
            raise UnavailableError(
                f"{kind} {item_id!r} waits in {target} to be uploaded; `complete_uploads` does so, "
                "as does the store's service while it runs"
            )
        if not replaces and self.exists(kind, item_id):
            raise ConflictError(f"{kind} {item_id!r} exists already; choose another id")
        stage = new_stage(self.root, kind, item_id)
        writer = UploadingWriter(stage=stage, target=target, attributes=attributes)
        writer.upload = lambda: self._upload(kind, target)
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
        return self._bucket.head(f"{group_key(kind, item_id)}/{COMMIT_FILE}") is not None

    def num_bytes(self, kind: Kind, item_id: str) -> int:
        """Size of a committed group in the bucket."""
        group = group_key(kind, item_id)
        sizes = {facts.key: facts.size for facts in self._bucket.list(group)}
        if f"{group}/{COMMIT_FILE}" not in sizes:
            raise self._missing(kind, item_id)
        return sum(sizes.values())

    def list(self, kind: Kind) -> list[str]:
        """Sorted committed ids; takes one request per 1000 objects in the bucket."""
        keys = (facts.key.split("/") for facts in self._bucket.list(f"{kind}s"))
        return sorted(parts[1] for parts in keys if len(parts) == 3 and parts[2] == COMMIT_FILE)

    def folder_numbers(self, kind: Kind) -> dict[str, int]:
        """Ids of a kind; takes one request per 1000 of them."""
        return dict.fromkeys(self._bucket.folders(f"{kind}s"), 0)

    def changes(self) -> dict[str, tuple[Kind, str]]:
        """See `EpisodeStore.changes`; takes one request per 1000 changes."""
        found = (facts.key.split("/") for facts in _announced(self._bucket))
        return {
            parts[3]: (kind, parts[2])
            for parts in found
            for kind in KINDS
            if len(parts) == 4 and parts[1] == f"{kind}s"
        }

    def fingerprints(self, kind: Kind, numbers: Mapping[str, int]) -> dict[str, GroupFingerprint]:
        """Entity tags of what a catalog is made of: of few ids one by one, of many from a list."""
        is_few = len(numbers) <= _MAX_ONE_BY_ONE
        folders = [group_key(kind, name) for name in numbers] if is_few else [f"{kind}s"]
        tags: dict[str, dict[str, str]] = {}
        for facts in (one for folder in folders for one in self._bucket.list(folder)):
            _, name, *rest = facts.key.split("/")
            tags.setdefault(name, {})["/".join(rest)] = facts.etag
        return {
            name: GroupFingerprint(
                number,
                f"{tags[name][COMMIT_FILE]} {tags[name].get(METADATA_FILE, '')}",
                " ".join(tags[name].get(file, "") for file in REMARK_FILES),
            )
            for name, number in numbers.items()
            if COMMIT_FILE in tags.get(name, {})
        }

    def delete(self, kind: Kind, item_id: str) -> None:
        """Delete a group: its commit record first, then its other objects."""
        self.group(kind, item_id)
        group = group_key(kind, item_id)
        self._bucket.put(f"{group}/{CLAIM_FILE}", _DELETING)
        self._bucket.remove([f"{group}/{COMMIT_FILE}"])
        try:
            _remove_files(self._bucket, group, [facts.key for facts in self._bucket.list(group)])
        finally:
            _announce(self._bucket, group)

    def set_remark(self, kind: Kind, item_id: str, name: str, content: bytes | None) -> None:
        """Put a file beside the content in place of an earlier one; None removes it."""
        key = f"{group_key(kind, item_id)}/{name}"
        if content is None:
            self._bucket.remove([key])
        else:
            self._bucket.put(key, content)
        _announce(self._bucket, group_key(kind, item_id))

    def get_file(self, name: str) -> bytes | None:
        """An object beside the groups; None if it does not exist."""
        return self._bucket.get(name)

    def put_file(self, name: str, content: bytes) -> None:
        """Put an object beside the groups in place of an earlier one."""
        self._bucket.put(name, content)

    def held(self, kind: Kind, item_id: str, *, waits: bool) -> AbstractContextManager[None]:
        """Nothing: a bucket has no locks; only that the group exists."""
        self.group(kind, item_id)
        return nullcontext()

    def complete_uploads(self) -> builtins.list[tuple[Kind, str]]:
        """Upload what waits in the outbox; see `EpisodeStore.complete_uploads`."""
        if not self.root.is_dir():
            return []
        self._own_work_folder()
        done: builtins.list[tuple[Kind, str]] = []
        failures: builtins.list[DexTouchError] = []
        for kind in KINDS:
            for folder in unheld_folders(self._outbox / f"{kind}s"):
                try:
                    if self._deliver(kind, folder):
                        done.append((kind, folder.name))
                except DexTouchError as error:
                    failures.append(error)
        if failures:
            for other in failures[1:]:
                failures[0].add_note(f"also: {other.message}")
            if done:
                names = ", ".join(f"{kind} {item_id!r}" for kind, item_id in done)
                failures[0].add_note(f"uploaded: {names}")
            raise failures[0]
        return done

    def sweep(self) -> int:
        """Remove abandoned stages, and objects of abandoned uploads."""
        with disk_errors("sweep"):
            removed = sweep_stages(self.root)
        return removed + sweep_orphans(self._bucket)

    def _upload(self, kind: Kind, folder: Path) -> None:
        try:
            upload_group(self._bucket, kind, folder)
        except (StorageError, UnavailableError) as error:
            raise type(error)(
                f"{error.message}; {kind} {folder.name!r} waits in {folder}, `complete_uploads` "
                "uploads it"
            ) from error
        except KeyboardInterrupt as interrupt:
            if (folder / COMMIT_FILE).exists():
                interrupt.add_note(
                    f"{kind} {folder.name!r} waits in {folder}, `complete_uploads` uploads it"
                )
            raise

    def _deliver(self, kind: Kind, folder: Path) -> bool:
        """Upload a group that no writer holds; False if there is none, or its id was taken."""
        if not (folder / COMMIT_FILE).exists():
            # The remainder of a group that was uploaded.
            with disk_errors(f"remove {folder}"):
                shutil.rmtree(folder)
            return False
        try:
            self._upload(kind, folder)
        except ConflictError:
            # It can be written again: a recording from its spool or file, an episode from that.
            logger.warning("upload_removed", kind=kind, item=folder.name, reason="its id was taken")
            shutil.rmtree(folder, ignore_errors=True)
            return False
        return True

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

    def _missing(self, kind: Kind, item_id: str) -> NotFoundError:
        return NotFoundError(f"{kind} {item_id!r}: not in the store {self._address}")


def group_key(kind: Kind, item_id: str) -> str:
    """Key prefix of a group."""
    return f"{kind}s/{item_id}"


def upload_group(bucket: Bucket, kind: Kind, folder: Path) -> None:
    """Upload a committed group and remove its local folder, which a failure keeps; repeatable.

    Raises ConflictError if the id has other content there, UnavailableError without a connection or
    if another writer uses the id, StorageError if the upload failed.
    """
    group, name = group_key(kind, folder.name), f"{kind} {folder.name!r}"
    with disk_errors(f"upload {name}"):
        commit = (folder / COMMIT_FILE).read_bytes()
    content = decode_commit(commit, what=name)[1]
    if not _is_committed(bucket, group, content, name):
        _claim(bucket, group, content, name)
        _put_files(bucket, group, folder)
        # Checked again, since a sweep may have considered this upload abandoned.
        _claim(bucket, group, content, name)
        if not bucket.put(f"{group}/{COMMIT_FILE}", commit, create=True):
            _is_committed(bucket, group, content, name)
    # Also after a kill between both: what is still here is uploaded again.
    _announce(bucket, group)
    with disk_errors(f"remove what was uploaded of {name}"):
        # First, so that the remainder after a kill does not pass for a group.
        (folder / COMMIT_FILE).unlink()
        shutil.rmtree(folder)


def sweep_orphans(bucket: Bucket, *, now: datetime | None = None) -> int:
    """Remove objects of abandoned uploads and deletions, and return the number of groups.

    The whole bucket is listed. ORPHAN_AGE counts back from `now`, the present by default. Changes
    of that age are removed, too, except the last one. What may not be deleted stays, with one line
    of the log.
    """
    limit = (datetime.now(UTC) if now is None else now) - ORPHAN_AGE
    removed, refused, is_probed = 0, dict[str, StorageError](), False
    denial: _DeletionRefusedError | None = None
    for group, keys in _orphans(bucket, limit):
        if denial is not None:
            refused[group] = denial
            continue
        try:
            if not is_probed:
                # A file that is not there, to be refused before a claim is marked: that would keep
                # what waits in an outbox from being uploaded ever.
                with _deleting():
                    bucket.remove([f"{group}/none"])
                is_probed = True
            removed += _remove_orphan(bucket, group, keys)
        except _DeletionRefusedError as error:
            refused[group] = denial = error
        except StorageError as error:
            refused[group] = error
    changes = sorted(_announced(bucket), key=lambda facts: facts.modified)
    try:
        with _deleting():
            bucket.remove([facts.key for facts in changes[:-1] if facts.modified < limit])
    except _DeletionRefusedError as error:
        refused[CHANGES] = denial = error
    if refused:
        remedy = "allow s3:DeleteObject, " if denial is not None else ""
        logger.warning(
            "orphans_not_removed",
            count=len(refused),
            places=[*refused][:_MAX_PLACES],
            reason=(denial or next(iter(refused.values()))).message,
            advice=f"they only take space; {remedy}the next sweep removes them",
        )
    return removed


def _orphans(bucket: Bucket, limit: datetime) -> Iterator[tuple[str, list[str]]]:
    """Groups without a commit record, and without a file since the limit, with their files."""
    for kind in KINDS:
        groups: dict[str, list[ObjectFacts]] = {}
        for facts in bucket.list(f"{kind}s"):
            groups.setdefault("/".join(facts.key.split("/")[:2]), []).append(facts)
        for group, files in groups.items():
            keys = [facts.key for facts in files]
            is_old = max(facts.modified for facts in files) < limit
            if is_old and f"{group}/{COMMIT_FILE}" not in keys:
                yield group, keys


def _remove_orphan(bucket: Bucket, group: str, keys: list[str]) -> bool:
    """Remove a group without a commit record; False if it has one meanwhile."""
    bucket.put(f"{group}/{CLAIM_FILE}", _DELETING)
    # It may have become active since it was listed.
    if bucket.head(f"{group}/{COMMIT_FILE}") is not None:
        return False
    with _deleting():
        _remove_files(bucket, group, keys)
    return True


class _DeletionRefusedError(StorageError):
    """What was to be deleted may not be."""


@contextmanager
def _deleting() -> Iterator[None]:
    try:
        yield
    except StorageError as error:
        raise _DeletionRefusedError(error.message) from error


def _announce(bucket: Bucket, group: str) -> None:
    """Tell catalogs that a group was changed; if that fails, they find it when they list all."""
    try:
        bucket.put(f"{CHANGES}/{group}/{uuid.uuid4().hex}", b"")
    except (StorageError, UnavailableError) as error:
        logger.warning("change_not_announced", group=group, reason=error.message)


def _announced(bucket: Bucket) -> builtins.list[ObjectFacts]:
    with suppress(StorageError):
        return builtins.list(bucket.list(CHANGES))
    return []


def _claim(bucket: Bucket, group: str, content: str, name: str) -> None:
    """Claim a group, so that only equal content can be written from now on."""
    key, mine = f"{group}/{CLAIM_FILE}", content.encode()
    bucket.put(key, mine, create=True)
    if bucket.get(key) == mine:
        _is_committed(bucket, group, content, name)
        # Read again: a deletion marks the claim before it removes the commit record.
        if bucket.get(key) == mine:
            return
    _is_committed(bucket, group, content, name)
    raise UnavailableError(
        f"{name}: something else is uploaded or deleted under this id in {bucket.address}; try "
        f"again, or sweep the store {ORPHAN_AGE.days} day after the other one died"
    )


def _is_committed(bucket: Bucket, group: str, content: str, name: str) -> bool:
    found = bucket.get(f"{group}/{COMMIT_FILE}")
    if found is None:
        return False
    try:
        same = decode_commit(found, what=name)[1] == content
    except StorageError:
        # Damaged or of another version: different content in any case.
        same = False
    if not same:
        raise ConflictError(f"{name} exists already in {bucket.address}; choose another id")
    return True


def _put_files(bucket: Bucket, group: str, folder: Path) -> None:
    names = [name for name in LocalGroup(folder).names() if name != COMMIT_FILE]
    with ThreadPoolExecutor(_PARALLEL_REQUESTS) as pool:
        # The first failure cancels what has not begun.
        for _ in pool.map(lambda name: bucket.put(f"{group}/{name}", folder / name), names):
            pass


def _remove_files(bucket: Bucket, group: str, keys: list[str]) -> None:
    claim = f"{group}/{CLAIM_FILE}"
    bucket.remove([key for key in keys if key != claim])
    bucket.remove([claim])
