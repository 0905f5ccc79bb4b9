"""Folders of a store beside its items: stages, swept after a kill, downloads, the catalog."""

import errno
import shutil
import uuid
from collections.abc import Iterable, Mapping
from pathlib import Path

from dextouch.episodes.files import (
    MAX_METADATA_BYTES,
    disk_errors,
    sync_files,
    sync_folder,
    unheld_folders,
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
from dextouch.errors import ConflictError, StorageError
from dextouch.schemas import json_ready

STAGING = ".staging"
# Folders of running downloads, each with the ids of its items.
DOWNLOADS = ".downloads"
# Databases of the tables of `services.episode_store`; any other file there is removed as a whole,
# since the catalog is made anew from the items.
CATALOG_FOLDER = ".catalog"
JOURNALS = ("-wal", "-shm", "-journal")


def remove_catalog(path: Path) -> None:
    """Remove a database with its journals; processes that have it open do not notice."""
    for suffix in ("", *JOURNALS):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def new_stage(root: Path, kind: Kind, item_id: str) -> Path:
    """A unique path for a new stage; the folder is not created."""
    return root / STAGING / f"{kind}-{item_id}-{uuid.uuid4().hex}"


def sweep_stages(root: Path, places: Iterable[str] = (STAGING, DOWNLOADS)) -> int:
    """Remove abandoned stages and downloads, which a kill has left, and return their number."""
    removed = 0
    for place in places:
        for folder in unheld_folders(root / place):
            shutil.rmtree(folder)
            removed += 1
    return removed


def commit_stage(
    stage: Path, target: Path, attributes: Attributes, entries: Mapping[str, ArrayEntry]
) -> None:
    """Write metadata and commit record of finished arrays and rename the stage to its target.

    Raises ConflictError if the target exists, StorageError if it could not be read again.
    """
    group = group_metadata(json_ready(attributes), entries)
    record = CommitRecord(
        kind=kind_of(attributes),
        id=attributes_id(attributes),
        attributes_sha256=sha256_hex(group),
        arrays=dict(entries),
    )
    commit = encoded_record(record)
    if max(len(group), len(commit)) > MAX_METADATA_BYTES:
        raise StorageError(
            f"{record.kind} {record.id!r}: {METADATA_FILE} and {COMMIT_FILE} hold {len(group)} and "
            f"{len(commit)} bytes, expected at most {MAX_METADATA_BYTES} each; "
            "record it in parts, or with fewer streams"
        )
    with disk_errors(f"commit {record.id}"):
        for name, entry in entries.items():
            write_file(stage / name / METADATA_FILE, array_metadata(entry), sync=False)
        write_file(stage / METADATA_FILE, group, sync=False)
        # Everything in the commit record is synced before the record itself.
        shards = [stage / name / shard_path(len(entry.shape)) for name, entry in entries.items()]
        metadata = [stage / name / METADATA_FILE for name in entries]
        sync_files([*shards, *metadata, stage / METADATA_FILE])
        write_file(stage / COMMIT_FILE, commit)
    publish(stage, target)


def encoded_record(record: CommitRecord) -> bytes:
    """Bytes of a commit record.

    Where it would be too large, as of takes of many hours, without checksums of the longest arrays.
    Their sha256 stays, by which a verification still finds exchanged files.
    """
    data, arrays = encode_commit(record)[0], dict(record.arrays)
    size = len(data)
    for name in sorted(arrays, key=lambda name: -len(arrays[name].crc32c or "")):
        crcs = arrays[name].crc32c
        if size <= MAX_METADATA_BYTES or not crcs:
            break
        arrays[name] = arrays[name].model_copy(update={"crc32c": None})
        size -= len(crcs) - len("null")
    if arrays == record.arrays:
        return data
    return encode_commit(record.model_copy(update={"arrays": arrays}))[0]


def publish(stage: Path, target: Path) -> None:
    """Rename a complete stage to its target; raises ConflictError if that exists."""
    if target.exists():
        raise _taken(target)
    with disk_errors(f"commit {target.name}"):
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
