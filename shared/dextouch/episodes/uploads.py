"""Atomic upload of committed groups from local folders to a bucket.

Every group in a bucket carries a `claim` from before its first file until after its last one is
deleted: the sha256 of the content that may be there. Writers of equal content may run concurrently,
    since their files are equal; all others are refused before they overwrite anything.
"""

import shutil
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

from dextouch.data_folder import is_system_file
from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import COMMIT_FILE, KINDS, Kind, decode_commit
from dextouch.episodes.object_bucket import Bucket, ObjectFacts
from dextouch.errors import ConflictError, StorageError, UnavailableError

CLAIM_FILE = "claim"
# A hash that no content has, so that nothing is written while a group is deleted.
_DELETING = b"deleting"
# Uploads older than this count as abandoned.
ORPHAN_AGE = timedelta(days=1)
_PARALLEL_REQUESTS = 8


def group_key(kind: Kind, item_id: str) -> str:
    """Key prefix of a group."""
    return f"{kind}s/{item_id}"


def upload_group(bucket: Bucket, kind: Kind, folder: Path) -> None:
    """Upload a committed group and remove its local folder; may be repeated after a failure.

    Raises:
        ConflictError: the id has other content there; the folder is kept.
        UnavailableError: no connection, or another writer uses the id; the folder is kept.
        StorageError: the upload failed; the folder is kept.
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
    with disk_errors(f"remove what was uploaded of {name}"):
        # First, so that the remainder after a kill does not pass for a group.
        (folder / COMMIT_FILE).unlink()
        shutil.rmtree(folder)


def delete_group(bucket: Bucket, kind: Kind, item_id: str) -> None:
    """Delete a group: its commit record first, then its other objects."""
    group = group_key(kind, item_id)
    bucket.put(f"{group}/{CLAIM_FILE}", _DELETING)
    bucket.remove([f"{group}/{COMMIT_FILE}"])
    _remove_files(bucket, group, [facts.key for facts in bucket.list(group)])


def sweep_orphans(bucket: Bucket, *, now: datetime | None = None) -> int:
    """Remove objects of abandoned uploads and deletions, and return the number of groups.

    The whole bucket is listed. ORPHAN_AGE counts back from `now`, the present by default.
    """
    limit = (datetime.now(UTC) if now is None else now) - ORPHAN_AGE
    removed = 0
    for kind in KINDS:
        groups: dict[str, list[ObjectFacts]] = {}
        for facts in bucket.list(f"{kind}s"):
            groups.setdefault("/".join(facts.key.split("/")[:2]), []).append(facts)
        for group, files in groups.items():
            keys = [facts.key for facts in files]
            is_old = max(facts.modified for facts in files) < limit
            if not is_old or f"{group}/{COMMIT_FILE}" in keys:
                continue
            bucket.put(f"{group}/{CLAIM_FILE}", _DELETING)
            # It may have become active since it was listed.
            if bucket.head(f"{group}/{COMMIT_FILE}") is None:
                _remove_files(bucket, group, keys)
                removed += 1
    return removed


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
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    files = {path.relative_to(folder).as_posix(): path for path in paths}
    files = {name: path for name, path in files.items() if not is_system_file(name)}
    del files[COMMIT_FILE]
    with ThreadPoolExecutor(_PARALLEL_REQUESTS) as pool:
        # The first failure cancels what has not begun.
        for _ in pool.map(bucket.put, [f"{group}/{name}" for name in files], files.values()):
            pass


def _remove_files(bucket: Bucket, group: str, keys: list[str]) -> None:
    claim = f"{group}/{CLAIM_FILE}"
    bucket.remove([key for key in keys if key != claim])
    bucket.remove([claim])
