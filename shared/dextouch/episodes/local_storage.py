"""Storage backend in a local folder, where a commit is a rename."""

import builtins
import re
import shutil
import uuid
from pathlib import Path
from urllib.parse import unquote, urlsplit

from dextouch.episodes.files import disk_errors, folder_bytes, sync_folder
from dextouch.episodes.format import COMMIT_FILE, Attributes, Kind, attributes_id
from dextouch.episodes.migration import OldGroup, is_current
from dextouch.episodes.sources import LocalGroup
from dextouch.episodes.staged_group import STAGING, abandoned_stages, new_stage
from dextouch.episodes.staging_recovery import (
    RecoveredGroup,
    ids_below,
    raise_first,
    recover_all,
    recover_stage,
    sweep_stages,
)
from dextouch.episodes.trash import put_into_trash, remove_for_good
from dextouch.episodes.write_options import WriteOptions
from dextouch.episodes.writer import EpisodeWriter, write_blocks
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.schemas import ID_PATTERN


def local_folder(url: str | Path) -> Path:
    """Local folder of a store's URL: a path, or `file:///…`.

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
        f"episode store: got {url!r}, expected a local folder, file:///… or s3://bucket/prefix"
    )


class LocalStorage:
    """Stores committed groups as `episodes/ID` and `recordings/ID` below one folder.

    The folder is created on the first write.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def writer(self, kind: Kind, attributes: Attributes, options: WriteOptions) -> EpisodeWriter:
        """Writer of a new group."""
        target = self._folder(kind, attributes_id(attributes))
        if target.exists():
            raise ConflictError(f"{kind} {target.name!r} exists already; choose another id")
        stage = new_stage(self.root, kind, target.name)
        return EpisodeWriter(stage=stage, target=target, attributes=attributes, options=options)

    def group(self, kind: Kind, item_id: str) -> LocalGroup:
        """Files of a committed group."""
        if not self.exists(kind, item_id):
            raise NotFoundError(f"{kind} {item_id!r}: not in the store {self.root}")
        return LocalGroup(self._folder(kind, item_id))

    def exists(self, kind: Kind, item_id: str) -> bool:
        """Whether an id is committed."""
        with disk_errors(f"look at {kind} {item_id}"):
            return (self._folder(kind, item_id) / COMMIT_FILE).is_file()

    def revision(self, kind: Kind, item_id: str) -> int:
        """Modification time of the commit record in nanoseconds."""
        with disk_errors(f"look at {kind} {item_id}"):
            return (self.group(kind, item_id).folder / COMMIT_FILE).stat().st_mtime_ns

    def num_bytes(self, kind: Kind, item_id: str) -> int:
        """Size of a committed group on disk."""
        return folder_bytes(self.group(kind, item_id).folder)

    def list(self, kind: Kind) -> list[str]:
        """Sorted committed ids."""
        folder = self.root / f"{kind}s"
        with disk_errors(f"list {kind}s"):
            if not folder.is_dir():
                return []
            return sorted(path.name for path in folder.iterdir() if _is_committed(path))

    def delete(self, kind: Kind, item_id: str) -> None:
        """Delete a group permanently; it disappears atomically and is then removed from disk."""
        remove_for_good(put_into_trash(self.root, kind, item_id))

    def migrate(self, kind: Kind, item_id: str) -> bool:
        """Replace a group of an older format version atomically; its lineage names the old one."""
        files = self.group(kind, item_id)
        if is_current(files, what=f"{kind} {item_id}"):
            return False
        old = OldGroup(files, kind)
        staging, number = self.root / STAGING, uuid.uuid4().hex
        # Committed beside the store first: after a kill between the two renames below, `recover`
        # finds a complete group whose place is free.
        whole, before = (
            staging / f"migrated-{item_id}-{number}",
            staging / f"old-{item_id}-{number}",
        )
        streams = ((stream.name, old.blocks(stream)) for stream in old.attributes.streams)
        write_blocks(new_stage(self.root, kind, item_id), whole, old.attributes, streams)
        with disk_errors(f"migrate {item_id}"):
            files.folder.rename(before)
            whole.rename(files.folder)
            sync_folder(files.folder.parent)
            shutil.rmtree(before)
        return True

    def recover(self) -> builtins.list[RecoveredGroup]:
        """Commit the stages of terminated writers, as far as they were written."""
        stages = abandoned_stages(self.root)
        found, failures = recover_all(stages, lambda stage: recover_stage(stage, self.root))
        raise_first(failures, found)
        return found

    def sweep(self) -> int:
        """Remove stages that cannot be recovered and return their number."""
        with disk_errors("sweep"):
            return sweep_stages(self.root, ids_below(self.root))

    def _folder(self, kind: Kind, item_id: str) -> Path:
        return self.root / f"{kind}s" / item_id


def _is_committed(folder: Path) -> bool:
    """Whether a group exists; an inaccessible one counts, since opening it explains why."""
    try:
        return (folder / COMMIT_FILE).is_file()
    except PermissionError:
        return re.fullmatch(ID_PATTERN, folder.name) is not None
