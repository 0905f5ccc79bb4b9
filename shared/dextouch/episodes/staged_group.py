"""A stage: the folder in which a group is written, and its commit to the final place.

What an interrupted writer leaves of a stage is never read: a sweep removes it.
"""

import errno
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path

from dextouch.episodes.files import (
    disk_errors,
    is_folder_at,
    sync_files,
    sync_folder,
    try_lock,
    write_file,
)
from dextouch.episodes.format import (
    COMMIT_FILE,
    METADATA_FILE,
    ArrayEntry,
    Attributes,
    CommitRecord,
    Kind,
    array_metadata,
    attributes_id,
    encode_commit,
    group_metadata,
    kind_of,
    sha256_hex,
    shard_path,
)
from dextouch.errors import ConflictError
from dextouch.schemas import json_ready
from dextouch.system_files import is_system_file

STAGING = ".staging"


def new_stage(root: Path, kind: Kind, item_id: str) -> Path:
    """A unique path for a new stage; the folder is not created."""
    return root / STAGING / f"{kind}-{item_id}-{uuid.uuid4().hex}"


def unheld_folders(parent: Path) -> Iterator[Path]:
    """Iterate over folders not locked by a writer, holding each one's lock meanwhile."""
    for folder in sorted(parent.iterdir()) if parent.is_dir() else []:
        if is_system_file(folder.name):
            continue
        try:
            lock = try_lock(folder)
        except FileNotFoundError:
            continue  # committed since we listed
        if lock is None:
            continue
        try:
            # Its writer may have committed and unlocked it before we locked it.
            if is_folder_at(lock, folder):
                yield folder
        finally:
            os.close(lock)


def sweep_stages(root: Path) -> int:
    """Remove abandoned stages, which killed writers have left, and return their number."""
    removed = 0
    for stage in unheld_folders(root / STAGING):
        shutil.rmtree(stage)
        removed += 1
    return removed


def commit_stage(
    stage: Path, target: Path, attributes: Attributes, entries: Mapping[str, ArrayEntry]
) -> None:
    """Write metadata and commit record of finished arrays and rename the stage to its target.

    Raises:
        ConflictError: the target exists.
    """
    group = group_metadata(json_ready(attributes))
    record = CommitRecord(
        kind=kind_of(attributes),
        id=attributes_id(attributes),
        attributes_sha256=sha256_hex(group),
        arrays=dict(entries),
    )
    with disk_errors(f"commit {record.id}"):
        for name, entry in entries.items():
            write_file(stage / name / METADATA_FILE, array_metadata(entry), sync=False)
        write_file(stage / METADATA_FILE, group, sync=False)
        # Everything in the commit record is synced before the record itself.
        shards = [stage / name / shard_path(len(entry.shape)) for name, entry in entries.items()]
        metadata = [stage / name / METADATA_FILE for name in entries]
        sync_files([*shards, *metadata, stage / METADATA_FILE])
        write_file(stage / COMMIT_FILE, encode_commit(record)[0])
    if target.exists():
        raise _taken(target)
    with disk_errors(f"commit {record.id}"):
        sync_folder(stage)
        target.parent.mkdir(parents=True, exist_ok=True)
        # Renaming a folder onto one that is not empty fails, so a race cannot overwrite.
        try:
            stage.rename(target)
        except OSError as error:
            if error.errno not in {errno.ENOTEMPTY, errno.EEXIST}:
                raise
            raise _taken(target) from error
        sync_folder(target.parent)


def _taken(target: Path) -> ConflictError:
    return ConflictError(
        f"{target.parent.name.rstrip('s')} {target.name!r} exists already; choose another id"
    )
