"""Committed groups in local folders → the same groups in a bucket, each whole or not at all.

Every group in a bucket carries a `claim` from before its first file until after its last one is
deleted: the sha256 of the content that may be there. Writers of equal content may repeat and help
each other, since their files are equal; all others are refused before they overwrite anything.
"""

import shutil
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import COMMIT_FILE, KINDS, Kind, decode_commit
from dextouch.episodes.object_bucket import Bucket, ObjectFacts
from dextouch.errors import ConflictError, StorageError, UnavailableError

CLAIM_FILE = "claim"
# No content has this hash: nothing may be written while a group is deleted.
_DELETING = b"deleting"
# An upload that takes longer is taken for dead.
ORPHAN_AGE = timedelta(days=1)
_PARALLEL_REQUESTS = 8


def group_key(kind: Kind, item_id: str) -> str:
    """The prefix of all keys of a group."""
    return f"{kind}s/{item_id}"


def upload_group(bucket: Bucket, kind: Kind, folder: Path) -> None:
    """Put a committed group into a bucket and remove its folder; may be repeated after a failure.

    Args:
        bucket: to write to.
        kind: of the group.
        folder: of the group, named by its id.

    Raises:
        ConflictError: the id has other content there; the folder stays.
        UnavailableError: no connection, or another writer is at the id; the folder stays.
        StorageError: the upload failed; the folder stays.
    """
    group, name = group_key(kind, folder.name), f"{kind} {folder.name!r}"
    with disk_errors(f"upload {name}"):
        commit = (folder / COMMIT_FILE).read_bytes()
    content = decode_commit(commit, what=name)[1]
    if not _is_committed(bucket, group, content, name):
        _claim(bucket, group, content, name)
        _put_files(bucket, group, folder)
        # Asked again: a sweep may have taken this upload for dead.
        _claim(bucket, group, content, name)
        if not bucket.put(f"{group}/{COMMIT_FILE}", commit, create=True):
            _is_committed(bucket, group, content, name)
    with disk_errors(f"remove what was uploaded of {name}"):
        # First, so that nobody takes what a kill leaves of the rest for a group.
        (folder / COMMIT_FILE).unlink()
        shutil.rmtree(folder)


def delete_group(bucket: Bucket, kind: Kind, item_id: str) -> None:
    """Remove a group: it vanishes at once, its other files a moment later."""
    group = group_key(kind, item_id)
    bucket.put(f"{group}/{CLAIM_FILE}", _DELETING)
    bucket.remove([f"{group}/{COMMIT_FILE}"])
    _remove_files(bucket, group, [facts.key for facts in bucket.list(group)])


def sweep_orphans(bucket: Bucket, *, now: datetime | None = None) -> int:
    """Remove files of uploads and deletions that died; how many groups of them went comes back.

    Args:
        bucket: to look through, all of it.
        now: for what counts as dead, see ORPHAN_AGE; the present when not given.
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
            # It may have come to life since it was listed.
            if bucket.head(f"{group}/{COMMIT_FILE}") is None:
                _remove_files(bucket, group, keys)
                removed += 1
    return removed


def _claim(bucket: Bucket, group: str, content: str, name: str) -> None:
    """Make sure that only equal content is written from now on."""
    key, mine = f"{group}/{CLAIM_FILE}", content.encode()
    bucket.put(key, mine, create=True)
    if bucket.get(key) == mine:
        _is_committed(bucket, group, content, name)
        # Read again: a deletion marks the claim before it takes the commit record away.
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
        # Damaged or of another version: not ours in any case.
        same = False
    if not same:
        raise ConflictError(f"{name} exists already in {bucket.address}; choose another id")
    return True


def _put_files(bucket: Bucket, group: str, folder: Path) -> None:
    names = sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )
    with ThreadPoolExecutor(_PARALLEL_REQUESTS) as pool:
        puts = [
            pool.submit(bucket.put, f"{group}/{name}", folder / name)
            for name in names
            if name != COMMIT_FILE
        ]
        try:
            for put in puts:
                put.result()
        finally:
            for put in puts:
                put.cancel()


def _remove_files(bucket: Bucket, group: str, keys: list[str]) -> None:
    claim = f"{group}/{CLAIM_FILE}"
    bucket.remove([key for key in keys if key != claim])
    bucket.remove([claim])
