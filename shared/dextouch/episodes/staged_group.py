"""A stage: the folder in which a group is written, and its commit to the final place.

A stage holds one log per array (`dextouch.episodes.journal`), and `stage.json` with the attributes
if it is recoverable.
"""

import errno
import json
import os
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path

from dextouch.episodes.files import (
    disk_errors,
    is_folder_at,
    partial_name,
    replace_file,
    sync_files,
    sync_folder,
    try_lock,
    write_file,
)
from dextouch.episodes.format import (
    ATTRIBUTES,
    COMMIT_FILE,
    MALFORMED,
    METADATA_FILE,
    ArrayEntry,
    Attributes,
    CommitRecord,
    Kind,
    array_metadata,
    attributes_id,
    encode_commit,
    group_attributes,
    group_metadata,
    kind_of,
    sha256_hex,
    shard_path,
)
from dextouch.episodes.journal import forget_journal
from dextouch.episodes.sources import LocalGroup
from dextouch.errors import ConflictError, CorruptDataError
from dextouch.schemas import json_ready
from dextouch.system_files import is_system_file

STAGING = ".staging"
STAGE_FILE = "stage.json"


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


def write_stage(stage: Path, attributes: Attributes) -> None:
    """Write `stage.json`, so that `recover` can complete the stage."""
    known = {"kind": kind_of(attributes), "attributes": json_ready(attributes)}
    with disk_errors(f"write {STAGE_FILE} of {attributes_id(attributes)}"):
        replace_file(stage / STAGE_FILE, json.dumps(known).encode())


def read_stage(stage: Path) -> Attributes | None:
    """Attributes of the group in a stage; None where it is not recoverable.

    Raises:
        CorruptDataError: `stage.json` is damaged.
    """
    data = LocalGroup(stage).get(STAGE_FILE)
    if data is None:
        return None
    try:
        known = json.loads(data)
        return ATTRIBUTES[known["kind"]].model_validate_json(json.dumps(known["attributes"]))
    except MALFORMED as error:
        raise CorruptDataError(f"{stage.name}: {STAGE_FILE} is damaged ({error})") from error


def read_committed(stage: Path, kind: Kind) -> Attributes:
    """The attributes in the group metadata of a stage with a commit record.

    Raises:
        CorruptDataError: they are missing or damaged.
    """
    try:
        return group_attributes(LocalGroup(stage).get(METADATA_FILE) or b"", ATTRIBUTES[kind])
    except MALFORMED as error:
        raise CorruptDataError(f"{stage.name}: {METADATA_FILE} is damaged ({error})") from error


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
    publish_stage(stage, target, record)


def change_attributes(stage: Path, record: CommitRecord, attributes: Attributes) -> CommitRecord:
    """Replace the attributes of a stage with a valid commit record and return the new record.

    After a kill between the two files their ids differ; repeat the call then.
    """
    group = group_metadata(json_ready(attributes))
    update = {"id": attributes_id(attributes), "attributes_sha256": sha256_hex(group)}
    changed = record.model_copy(update=update)
    with disk_errors(f"commit {changed.id}"):
        replace_file(stage / METADATA_FILE, group)
        replace_file(stage / COMMIT_FILE, encode_commit(changed)[0])
    return changed


def publish_stage(stage: Path, target: Path, record: CommitRecord) -> None:
    """Rename a stage with a valid commit record to its target.

    Raises:
        ConflictError: the target exists; the stage is still recoverable.
    """
    if target.exists():
        raise _taken(target)
    known = read_stage(stage)
    # The journals are removed only once recovery no longer needs them.
    for name in record.arrays:
        forget_journal(stage, name)
    with disk_errors(f"commit {record.id}"):
        partials = (partial_name(name) for name in (STAGE_FILE, METADATA_FILE, COMMIT_FILE))
        for name in (STAGE_FILE, *partials):
            (stage / name).unlink(missing_ok=True)
        sync_folder(stage)
        target.parent.mkdir(parents=True, exist_ok=True)
        # Renaming a folder onto one that is not empty fails, so a race cannot overwrite.
        try:
            stage.rename(target)
        except OSError as error:
            if error.errno not in {errno.ENOTEMPTY, errno.EEXIST}:
                raise
            if known is not None:
                write_stage(stage, known)
            raise _taken(target) from error
        sync_folder(target.parent)


def _taken(target: Path) -> ConflictError:
    return ConflictError(
        f"{target.parent.name.rstrip('s')} {target.name!r} exists already; choose another id"
    )
