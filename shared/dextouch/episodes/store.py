"""Store of episodes and recordings in a folder or a bucket: open, list, write, delete by id."""

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

from dextouch.data_folder import is_bucket_url
from dextouch.episodes.files import (
    GroupFiles,
    GroupFingerprint,
    LocalGroup,
    disk_errors,
    folder_bytes,
    replace_file,
    sync_folder,
    try_lock,
)
from dextouch.episodes.format import (
    ATTRIBUTES,
    COMMIT_FILE,
    KINDS,
    METADATA_FILE,
    Attributes,
    Kind,
    attributes_id,
    check_id,
    stated_sha256,
)
from dextouch.episodes.groups import A, GroupContents, read_group
from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.staging import new_stage, sweep_stages
from dextouch.episodes.trash import (
    CLICKS_FILE,
    NOTES_FILE,
    REMARK_FILES,
    REVIEW_FILE,
    Remark,
    TrashEntry,
    TrashKind,
    change_trashed_review,
    list_trash,
    purge_trash,
    put_into_trash,
    read_remark,
    remove_for_good,
    restore_from_trash,
)
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    NotFoundError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.installation import install_command
from dextouch.schemas import (
    ID_PATTERN,
    EpisodeAttributes,
    EpisodeClicks,
    ItemNotes,
    LineageEntry,
    RecordingAttributes,
    Review,
)

if TYPE_CHECKING:
    from dextouch.episodes.bucket_storage import ObjectStorage


_IS_ID = re.compile(ID_PATTERN).fullmatch


class EpisodeStore:
    """All episodes and recordings below one address.

    Concurrent use from several processes is safe: committed groups are immutable, and uncommitted
    ones are invisible.

    `url` is a local folder, `file:///…`, or `s3://bucket/prefix` with the options `endpoint`,
    `region` and others of `dextouch.episodes.s3_bucket` after a `?`; its credentials are
    storage options, or in the usual AWS_* environment, which obstore reads. `root` is the local
    folder of unfinished groups: the store itself if that is a folder, otherwise the work folder.
    """

    def __init__(self, url: str | Path, storage_options: Mapping[str, str] | None = None) -> None:
        self.url = str(url)
        self._storage = _open_storage(url, storage_options or {})
        self.root = self._storage.root

    @property
    def folders(self) -> tuple[Path, ...]:
        """The folder that other machines must see to use this store; none for a bucket."""
        return (self.root,) if isinstance(self._storage, _LocalStorage) else ()

    def require_folder(self) -> "EpisodeStore":
        """The store itself; raises NotFoundError without its folder, as where none is mounted."""
        if self.folders and not self.root.is_dir():
            raise NotFoundError(f"store {self.root}: no such folder; mount it, or name another one")
        return self

    def writer(
        self, *, kind: Kind = "episode", attributes: Attributes, replaces: bool = False
    ) -> EpisodeWriter:
        """A context manager that writes one episode or recording.

        With `replaces` its id may exist until the end of the context, where it must be gone.

        Raises ConflictError for an id that exists, InvalidInputError for attributes of the other
        kind.
        """
        model = ATTRIBUTES[_check_kind(kind)]
        if not isinstance(attributes, model):
            raise InvalidInputError(
                f"writer: got {type(attributes).__name__}, expected {model.__name__} for {kind!r}"
            )
        _check(kind, attributes_id(attributes))
        return self._storage.writer(kind, attributes, replaces=replaces)

    def open(self, episode_id: str) -> EpisodeReader:
        """Open a committed episode.

        Raises NotFoundError without it, CorruptDataError or StorageError if it is damaged, or of a
        newer format.
        """
        return EpisodeReader(self._read("episode", episode_id, EpisodeAttributes))

    def recording(self, recording_id: str) -> RecordingReader:
        """Open a finished recording; raises as `open`."""
        return RecordingReader(self._read("recording", recording_id, RecordingAttributes))

    def open_item(self, kind: Kind, item_id: str) -> EpisodeReader | RecordingReader:
        """Open an episode or a recording; raises as `open`."""
        return self.open(item_id) if _check_kind(kind) == "episode" else self.recording(item_id)

    def _read(self, kind: Kind, item_id: str, model: type[A]) -> GroupContents[A]:
        """Open a group; damage of one that is gone is a NotFoundError."""
        group = self._storage.group(*_check(kind, item_id))
        try:
            return read_group(group, model)
        except CorruptDataError:
            self._storage.group(kind, item_id)
            raise

    def files(self, item_id: str, *, kind: Kind = "episode") -> GroupFiles:
        """The raw files of a committed group, for inspection and repair; raises as `num_bytes`."""
        return self._storage.group(*_check(kind, item_id))

    def exists(self, item_id: str, *, kind: Kind = "episode") -> bool:
        """Whether an id is committed."""
        return self._storage.exists(*_check(kind, item_id))

    def has_source(self, source: LineageEntry) -> bool:
        """Whether the item that a lineage entry names is there, and no other one of its id."""
        kind = next((kind for kind in KINDS if kind == source.kind), None)
        if kind is None or not self.exists(source.id, kind=kind):
            return False
        if source.sha256 is None:
            return True
        commit = self._storage.group(kind, source.id).get(COMMIT_FILE)
        return source.is_of(stated_sha256(commit))

    def num_bytes(self, item_id: str, *, kind: Kind = "episode") -> int:
        """Size of a committed group; raises NotFoundError without the id."""
        return self._storage.num_bytes(*_check(kind, item_id))

    def list(self, *, kind: Kind = "episode") -> list[str]:
        """Sorted committed ids."""
        return self._storage.list(_check_kind(kind))

    def folder_numbers(self, *, kind: Kind = "episode") -> dict[str, int]:
        """Ids of a kind, committed or not, each with a number that changes with its folder.

        Far faster than `list`: one look at the folder, and in a bucket one request per 1000 ids,
        where all numbers are 0.
        """
        return self._storage.folder_numbers(_check_kind(kind))

    def changes(self) -> Mapping[str, tuple[Kind, str]]:
        """Kinds and ids of items that were changed lately in a bucket, by names of the changes.

        A change is announced when everybody sees it, and kept for a day, the last one for longer.
        None in a folder, and in a bucket that only earlier releases have changed.
        """
        return {} if isinstance(self._storage, _LocalStorage) else self._storage.changes()

    def fingerprints(
        self, numbers: Mapping[str, int], *, kind: Kind = "episode"
    ) -> dict[str, GroupFingerprint]:
        """Fingerprints of those of these ids that are committed; `numbers` are their folder's.

        They change when the content or the remarks of an item are replaced, or edited by hand.
        """
        return self._storage.fingerprints(_check_kind(kind), numbers)

    def review(self, item_id: str, *, kind: Kind = "episode") -> Review | None:
        """The review of an item; None if nobody reviewed it.

        Raises NotFoundError without the id, CorruptDataError if its review cannot be read.
        """
        return self._remark(kind, item_id, REVIEW_FILE, Review)

    def _remark(self, kind: Kind, item_id: str, name: str, form: type[Remark]) -> Remark | None:
        group = self._storage.group(*_check(kind, item_id))
        return read_remark(group, name, form, what=f"{kind} {item_id!r}")

    def set_review(self, item_id: str, review: Review | None, *, kind: Kind = "episode") -> None:
        """Keep the review of an item in place of an earlier one; None removes it.

        That an edit supersedes the item stays, unless the item is accepted after the edit. Raises
        NotFoundError without the id.
        """
        before = self._readable_review(kind, item_id)
        # Results that whoever reviews the item could know of.
        results = () if before is None else before.superseded_by
        is_known = any(self.exists(name, kind=kind) for name in results)
        with self._storage.held(*_check(kind, item_id), waits=True):
            now = self._readable_review(kind, item_id)
            if now is not None and now.superseded_by and not (review and review.superseded_by):
                is_known = is_known and results == now.superseded_by
                if review is None or review.verdict == "rejected" or not is_known:
                    review = now.model_copy(update={"earlier": review})
            self._set_remark(kind, item_id, REVIEW_FILE, review)

    def _readable_review(self, kind: Kind, item_id: str) -> Review | None:
        with suppress(CorruptDataError):
            return self.review(item_id, kind=kind)
        return None

    def change_source_review(
        self,
        source: LineageEntry,
        change: Callable[[Review | None], Review | None],
        *,
        is_held: bool = False,
    ) -> None:
        """Change the review of an edited item that a lineage entry names, also in the trash.

        `is_held` says that the caller holds it; otherwise it is held meanwhile.
        """
        kind: Kind = "episode" if source.kind == "episode" else "recording"
        if self.has_source(source):
            held = nullcontext() if is_held else self._storage.held(kind, source.id, waits=True)
            with held:
                review = self.review(source.id, kind=kind)
                changed = change(review)
                if changed != review:
                    self._set_remark(kind, source.id, REVIEW_FILE, changed)
        for folder in self.folders:
            change_trashed_review(folder, source, change)

    def clicks(self, episode_id: str) -> EpisodeClicks | None:
        """Clicks on the objects of an episode; None if there are none. Raises as `review`."""
        return self._remark("episode", episode_id, CLICKS_FILE, EpisodeClicks)

    def set_clicks(self, episode_id: str, clicks: EpisodeClicks | None) -> None:
        """Keep clicks in place of earlier ones; None removes them. Raises as `set_review`."""
        self._set_remark("episode", episode_id, CLICKS_FILE, clicks)

    def notes(self, item_id: str, *, kind: Kind = "episode") -> ItemNotes:
        """Notes on time ranges of an item. Raises as `review`."""
        return self._remark(kind, item_id, NOTES_FILE, ItemNotes) or ItemNotes()

    def change_notes(
        self, item_id: str, change: Callable[[ItemNotes], ItemNotes], *, kind: Kind = "episode"
    ) -> ItemNotes:
        """Keep what a function makes of the notes of an item, and return it; raises as `review`.

        In a folder no note of another program is lost meanwhile; a bucket keeps the last change.
        """
        with self._storage.held(*_check(kind, item_id), waits=True):
            found = change(self.notes(item_id, kind=kind))
            self._set_remark(kind, item_id, NOTES_FILE, found if found.notes else None)
        return found

    def copy_remarks(
        self, source: "EpisodeStore", item_id: str, *, kind: Kind, only_missing: bool = False
    ) -> bool:
        """Make the remarks on an item those of another store, byte for byte; whether any changed.

        With `only_missing` those that it has stay. Raises NotFoundError without the id in both.
        """
        theirs, ours = source.files(item_id, kind=kind), self.files(item_id, kind=kind)
        changed = {
            name: content
            for name in REMARK_FILES
            if (content := theirs.get(name)) != (own := ours.get(name))
            and not (only_missing and own is not None)
        }
        for name, content in changed.items():
            self._storage.set_remark(kind, item_id, name, content)
        return bool(changed)

    def get_file(self, name: str) -> bytes | None:
        """A small file of the store as a whole, beside its items; None where there is none."""
        return self._storage.get_file(name)

    def put_file(self, name: str, content: bytes) -> None:
        """Replace a file that `get_file` reads; nobody but its owner may read it."""
        self._storage.put_file(name, content)

    def held(self, item_id: str, *, kind: Kind = "episode") -> AbstractContextManager[None]:
        """Hold an item while it is edited, so that no other program edits it; not in a bucket.

        Raises NotFoundError without the id, UnavailableError while another program holds it.
        """
        return self._storage.held(*_check(kind, item_id), waits=False)

    def _set_remark(
        self, kind: Kind, item_id: str, name: str, remark: Review | EpisodeClicks | ItemNotes | None
    ) -> None:
        self._storage.group(*_check(kind, item_id))
        content = None if remark is None else remark.model_dump_json().encode()
        self._storage.set_remark(kind, item_id, name, content)

    def delete(self, item_id: str, *, kind: Kind = "episode", for_good: bool = False) -> None:
        """Move an item to the trash, or delete it `for_good`, as always in object storage.

        Also what is left in a folder of one that lost its commit record. Raises NotFoundError
        without the id.
        """
        _check(kind, item_id)
        if for_good or not isinstance(self._storage, _LocalStorage):
            self._storage.delete(kind, item_id)
        else:
            put_into_trash(self.root, kind, item_id)

    def restore(self, item_id: str, *, kind: TrashKind = "episode") -> None:
        """Restore the last deleted group of an id; raises as `restore_from_trash`."""
        restore_from_trash(self.require_trash(), kind, check_id(item_id))

    def trash_list(self) -> Sequence[TrashEntry]:
        """Contents of the trash, oldest first."""
        return list_trash(self.require_trash())

    def purge(self, *, older_than_s: float = 0.0) -> Sequence[TrashEntry]:
        """Permanently delete trash older than `older_than_s` and return the deleted entries."""
        return purge_trash(self.require_trash(), older_than_s=older_than_s)

    def require_trash(self) -> Path:
        """The folder; raises InvalidInputError for a store in a bucket, which has no trash."""
        if not isinstance(self._storage, _LocalStorage):
            raise InvalidInputError(
                "trash: got a store in a bucket, expected one in a folder; what is deleted from a "
                "bucket can only be restored from its older versions"
            )
        return self.root

    def complete_uploads(self) -> tuple[tuple[Kind, str], ...]:
        """Upload groups whose upload was interrupted after their commit; their kinds and ids.

        Only a store in a bucket has any: what is committed in a folder is in its place. Raises
        StorageError or UnavailableError if an upload failed; others are completed, and notes name
        them.
        """
        if isinstance(self._storage, _LocalStorage):
            return ()
        return tuple(self._storage.complete_uploads())

    def sweep(self) -> int:
        """Remove what killed writers have left, and return the number of stages and groups.

        Stages of running writers are not touched. In a bucket, groups without a commit record are
        removed once they are a day old; what waits to be uploaded is kept.
        """
        return self._storage.sweep()


def _open_storage(
    url: str | Path, storage_options: Mapping[str, str]
) -> "_LocalStorage | ObjectStorage":
    """Storage backend for a URL; see `EpisodeStore` for the arguments."""
    if is_bucket_url(url):
        # Imported lazily, so that a local store does not need obstore.
        try:
            from dextouch.episodes.bucket_storage import ObjectStorage
        except ModuleNotFoundError as error:
            if error.name != "obstore":
                raise
            raise UnavailableError(
                f"episode store: s3://… needs obstore; run `{install_command('s3')}`"
            ) from error
        return ObjectStorage(url, storage_options)
    if storage_options:
        raise InvalidInputError(
            f"episode store: got storage options for {str(url)!r}, "
            "expected them with s3://bucket/prefix only"
        )
    return _LocalStorage(local_folder(url))


def _check(kind: Kind, item_id: str) -> tuple[Kind, str]:
    return _check_kind(kind), check_id(item_id, kind=f"{kind} id")


def _check_kind(kind: Kind) -> Kind:
    if kind not in KINDS:
        raise UnknownNameError("kind", kind, list(KINDS))
    return kind


def local_folder(url: str | Path) -> Path:
    """Local folder of a store's URL: a path, or `file:///…`.

    Raises InvalidInputError for another scheme or host.
    """
    if isinstance(url, Path):
        return url
    parts = urlsplit(url)
    if not parts.scheme and url:
        return Path(url)
    if parts.scheme == "file" and parts.netloc in {"", "localhost"} and parts.path:
        return Path(unquote(parts.path))
    raise InvalidInputError(
        f"episode store: got {url!r}, expected a local folder, file:///… or s3://bucket/prefix"
    )


class _LocalStorage:
    """Stores committed groups as `episodes/ID` and `recordings/ID` below one folder.

    The folder is created on the first write.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def writer(self, kind: Kind, attributes: Attributes, *, replaces: bool) -> EpisodeWriter:
        target = self._folder(kind, attributes_id(attributes))
        if target.exists() and not replaces:
            raise ConflictError(f"{kind} {target.name!r} exists already; choose another id")
        stage = new_stage(self.root, kind, target.name)
        return EpisodeWriter(stage=stage, target=target, attributes=attributes)

    def group(self, kind: Kind, item_id: str) -> LocalGroup:
        if not self.exists(kind, item_id):
            raise self._missing(kind, item_id)
        return LocalGroup(self._folder(kind, item_id))

    def _missing(self, kind: Kind, item_id: str) -> NotFoundError:
        return NotFoundError(f"{kind} {item_id!r}: not in the store {self.root}")

    def exists(self, kind: Kind, item_id: str) -> bool:
        with disk_errors(f"look at {kind} {item_id}"):
            return (self._folder(kind, item_id) / COMMIT_FILE).is_file()

    def num_bytes(self, kind: Kind, item_id: str) -> int:
        return folder_bytes(self.group(kind, item_id).folder)

    def list(self, kind: Kind) -> list[str]:
        folder = self.root / f"{kind}s"
        with disk_errors(f"list {kind}s"):
            if not folder.is_dir():
                return []
            return sorted(path.name for path in folder.iterdir() if _is_committed(path))

    def folder_numbers(self, kind: Kind) -> dict[str, int]:
        with disk_errors(f"list {kind}s"):
            try:
                with os.scandir(self.root / f"{kind}s") as entries:
                    return {entry.name: entry.inode() for entry in entries}
            except FileNotFoundError:
                return {}

    def fingerprints(self, kind: Kind, numbers: Mapping[str, int]) -> dict[str, GroupFingerprint]:
        found, none = {}, " ".join([""] * len(REMARK_FILES))
        with disk_errors(f"look at {kind}s"):
            for name in filter(_IS_ID, numbers):
                folder = f"{self.root}/{kind}s/{name}/"
                try:
                    commit = _stamp(folder + COMMIT_FILE)
                    content = f"{commit} {_stamp(folder + METADATA_FILE)}"
                    # Most have none, and raising errors would take as long as all the rest.
                    remarks = none
                    for file in REMARK_FILES:
                        if os.access(folder + file, os.F_OK):
                            remarks = " ".join(_stamp(folder + one) for one in REMARK_FILES)
                            break
                except PermissionError:
                    # Reading it says what is wrong.
                    commit, content, remarks = "?", "? ", none
                if commit:
                    found[name] = GroupFingerprint(numbers[name], content, remarks)
        return found

    def delete(self, kind: Kind, item_id: str) -> None:
        """Delete a group permanently; it disappears atomically and is then removed from disk."""
        remove_for_good(put_into_trash(self.root, kind, item_id))

    def set_remark(self, kind: Kind, item_id: str, name: str, content: bytes | None) -> None:
        path = self._folder(kind, item_id) / name
        with disk_errors(f"write {name} of {kind} {item_id}"):
            try:
                if content is not None:
                    replace_file(path, content)
                elif path.exists():
                    path.unlink()
                    sync_folder(path.parent)
            except FileNotFoundError as error:
                # Deleted meanwhile: an item without the file has none to remove either.
                raise self._missing(kind, item_id) from error

    def get_file(self, name: str) -> bytes | None:
        path = self.root / name
        with disk_errors(f"read {path}"):
            return path.read_bytes() if path.is_file() else None

    def put_file(self, name: str, content: bytes) -> None:
        with disk_errors(f"write {self.root / name}"):
            self.root.mkdir(parents=True, exist_ok=True)
            replace_file(self.root / name, content, mode=0o600)

    @contextmanager
    def held(self, kind: Kind, item_id: str, *, waits: bool) -> Iterator[None]:
        """Hold the lock of a group's folder, which is that of a deletion, too."""
        with disk_errors(f"hold {kind} {item_id}"):
            try:
                lock = try_lock(self.group(kind, item_id).folder, waits=waits)
            except FileNotFoundError as error:
                raise self._missing(kind, item_id) from error
        if lock is None:
            raise UnavailableError(
                f"{kind} {item_id!r}: another program is changing it; try again when it is done"
            )
        try:
            yield
        finally:
            os.close(lock)

    def sweep(self) -> int:
        with disk_errors("sweep"):
            return sweep_stages(self.root)

    def _folder(self, kind: Kind, item_id: str) -> Path:
        return self.root / f"{kind}s" / item_id


def _stamp(path: str) -> str:
    """What changes with a file; empty without it. Plain paths: a store has many files."""
    try:
        state = os.stat(path)  # noqa: PTH116
    except (FileNotFoundError, NotADirectoryError):
        return ""
    return f"{state.st_mtime_ns}.{state.st_size}.{state.st_ino}"


def _is_committed(folder: Path) -> bool:
    """Whether a group exists; an inaccessible one counts, since opening it explains why."""
    try:
        return (folder / COMMIT_FILE).is_file()
    except PermissionError:
        return _IS_ID(folder.name) is not None
