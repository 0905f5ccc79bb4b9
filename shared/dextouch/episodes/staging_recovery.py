"""Recovery of abandoned stages: a terminated writer's data becomes a group marked as recovered."""

import hashlib
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import count
from pathlib import Path

import numpy as np

from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import (
    COMMIT_FILE,
    METADATA_FILE,
    ArrayEntry,
    Attributes,
    CommitRecord,
    Kind,
    attributes_id,
    decode_commit,
    kind_of,
    shard_path,
    stream_arrays,
    with_counts,
    with_rows,
)
from dextouch.episodes.journal import (
    JOURNAL_MAGIC,
    JOURNAL_ROW,
    JournalWriter,
    journal_path,
    part_path,
    read_payload,
    read_rows,
)
from dextouch.episodes.shards import CRC_BYTES, decode_rows, finish_shard
from dextouch.episodes.sources import LocalGroup
from dextouch.episodes.staged_group import (
    STAGE_FILE,
    STAGING,
    change_attributes,
    commit_stage,
    publish_stage,
    read_committed,
    read_stage,
    unheld_folders,
)
from dextouch.errors import CorruptDataError, DexTouchError, StorageError
from dextouch.schemas import RecordingAttributes

# Event of the ledger: samples of which only some arrays reached the disk.
INCOMPLETE = "incomplete_samples"
# Whether an id is in use.
IsTaken = Callable[[Kind, str], bool]


@dataclass(frozen=True)
class RecoveredGroup:
    """A group recovered from an interrupted take.

    `lost` counts the samples that only some of their arrays had, by stream.
    """

    kind: Kind
    item_id: str
    num_samples: dict[str, int]
    lost: Mapping[str, int] = field(default_factory=dict)


def ids_below(root: Path) -> IsTaken:
    """A check whether the folder of an id exists."""
    return lambda kind, item_id: (root / f"{kind}s" / item_id).exists()


def recover_all(
    folders: Iterable[Path], recover: Callable[[Path], RecoveredGroup | None]
) -> tuple[list[RecoveredGroup], list[DexTouchError]]:
    """Recover all folders, continuing after failures; returns the groups and the errors."""
    found: list[RecoveredGroup] = []
    failures: list[DexTouchError] = []
    for folder in folders:
        try:
            group = recover(folder)
        except DexTouchError as error:
            failures.append(error)
        else:
            found += [] if group is None else [group]
    return found, failures


def raise_first(failures: Sequence[DexTouchError], found: Sequence[RecoveredGroup]) -> None:
    """Raise the first error, if any, with notes about the others and the recovered groups."""
    if not failures:
        return
    for other in failures[1:]:
        failures[0].add_note(f"also: {other.message}")
    if found:
        names = ", ".join(f"{group.kind} {group.item_id!r}" for group in found)
        failures[0].add_note(f"recovered: {names}")
    raise failures[0]


def recover_stage(
    stage: Path, root: Path, is_taken: IsTaken | None = None
) -> RecoveredGroup | None:
    """Truncate every stream of a stage to its last complete storage chunk and commit the stage.

    No writer may hold the stage. The group appears in `root`, whose folders say which ids are in
    use unless `is_taken` does.

    Returns:
        The recovered group; None if there is nothing to recover, and the stage is unchanged.

    Raises:
        CorruptDataError: damage other than a torn tail, or no sample is whole although some were
            written; nothing is changed.
    """
    is_taken = is_taken or ids_below(root)
    record = _whole_commit(stage)
    if record is not None:
        return _publish(stage, root, record, is_taken)
    attributes = read_stage(stage)
    if attributes is None:
        return None
    # Before any shard is turned back into a log: a torn commit record must not pass for a valid
    # one.
    for name in (METADATA_FILE, COMMIT_FILE):
        (stage / name).unlink(missing_ok=True)
    kind, (num_samples, lost) = kind_of(attributes), _whole_samples(stage, attributes)
    if not any(num_samples.values()):
        return None
    entries = {}
    for stream in attributes.streams:
        for name, entry in stream_arrays(stream, kind).items():
            entries[name] = _cut_array(stage, name, entry, num_samples[stream.name])
    if isinstance(attributes, RecordingAttributes):
        attributes = attributes.as_interrupted()
    attributes = with_counts(_as_recovered(attributes, is_taken), INCOMPLETE, lost)
    target = root / f"{kind}s" / attributes_id(attributes)
    commit_stage(stage, target, attributes, entries)
    return RecoveredGroup(kind, target.name, num_samples, lost)


def _publish(
    stage: Path, root: Path, record: CommitRecord, is_taken: IsTaken
) -> RecoveredGroup | None:
    """Publish a stage with a valid commit record, under another id if its own is taken."""
    attributes = read_committed(stage, record.kind)
    if attributes_id(attributes) != record.id or is_taken(record.kind, record.id):
        # A group that can be recomputed has no `stage.json`.
        if not (stage / STAGE_FILE).is_file():
            return None
        record = change_attributes(stage, record, _as_recovered(attributes, is_taken))
    publish_stage(stage, root / f"{record.kind}s" / record.id, record)
    return RecoveredGroup(record.kind, record.id, samples_of(record, attributes))


def samples_of(record: CommitRecord, attributes: Attributes) -> dict[str, int]:
    """Number of samples by stream."""
    return {stream.name: record.arrays[stream.name].shape[0] for stream in attributes.streams}


def is_recoverable(stage: Path, is_taken: IsTaken) -> bool:
    """Whether `recover_stage` can recover an abandoned stage.

    A damaged stage counts, so that it is inspected before it is removed.
    """
    record = _whole_commit(stage)
    if record is not None:
        return (stage / STAGE_FILE).exists() or not is_taken(record.kind, record.id)
    try:
        attributes = read_stage(stage)
        return attributes is not None and any(_whole_samples(stage, attributes)[0].values())
    except CorruptDataError:
        return True


def sweep_stages(root: Path, is_taken: IsTaken) -> int:
    """Remove abandoned stages that `recover_stage` cannot recover, and return their number."""
    removed = 0
    for stage in unheld_folders(root / STAGING):
        if not is_recoverable(stage, is_taken):
            shutil.rmtree(stage)
            removed += 1
    return removed


def _whole_commit(stage: Path) -> CommitRecord | None:
    data = LocalGroup(stage).get(COMMIT_FILE)
    try:
        return None if data is None else decode_commit(data, what=stage.name)[0]
    except StorageError:
        # Torn by the crash: its content is recovered from the logs.
        return None


def _whole_samples(stage: Path, attributes: Attributes) -> tuple[dict[str, int], dict[str, int]]:
    """Samples of each stream up to the last chunk boundary common to all of its arrays.

    And how many more some of the arrays have, where there are any.
    """
    counts, lost, is_damaged = {}, {}, False
    for stream in attributes.streams:
        ends, num_written = [], 0
        for name, entry in stream_arrays(stream, kind_of(attributes)).items():
            rows, num_trusted = _journal_rows(stage, name, entry)
            written = np.cumsum(rows["num_rows"], dtype=np.int64)
            num_written = max(num_written, int(written[-1]) if len(written) else 0)
            # A kill leaves at most a part of a row.
            row_bytes = journal_path(stage, name).stat().st_size - len(JOURNAL_MAGIC)
            is_damaged |= row_bytes // JOURNAL_ROW.itemsize > num_trusted
            ends.append(written[:num_trusted])
        common = reduce(np.intersect1d, ends)
        counts[stream.name] = int(common[-1]) if len(common) else 0
        if num_written > counts[stream.name]:
            lost[stream.name] = num_written - counts[stream.name]
    if is_damaged and not any(counts.values()):
        raise CorruptDataError(
            f"{stage.name}: no sample is in all arrays of its stream, although there were {lost}; "
            "restore the files of the stage from a copy, or delete it"
        )
    return counts, lost


def _journal_rows(stage: Path, name: str, entry: ArrayEntry) -> tuple[np.ndarray, int]:
    """The rows of an array's journal, and how many of them have their payload."""
    shard = stage / name / shard_path(len(entry.shape))
    with disk_errors(f"recover {name}"):
        if shard.is_file():
            # The writer died while it committed: the shard becomes a log again.
            shard.rename(part_path(stage, name))
        # Not only then: a recovery that died after this rename has left the metadata here.
        if (stage / name).is_dir():
            shutil.rmtree(stage / name)
        part_path(stage, name).touch()
        journal_path(stage, name).touch()
    rows = read_rows(stage, name)
    num_trusted = len(rows)
    # After a power loss there may be rows without their payload.
    while num_trusted:
        try:
            read_payload(stage, name, rows[num_trusted - 1])
        except CorruptDataError:
            num_trusted -= 1
        else:
            break
    return rows, num_trusted


def _cut_array(stage: Path, name: str, entry: ArrayEntry, num_samples: int) -> ArrayEntry:
    rows, num_trusted = _journal_rows(stage, name, entry)
    rows = rows[:num_trusted]
    ends = np.cumsum(rows["num_rows"], dtype=np.int64)
    num_kept = int(np.searchsorted(ends, num_samples, side="right"))
    num_rows = int(ends[num_kept - 1]) if num_kept else 0
    if num_rows != num_samples:
        raise CorruptDataError(
            f"{stage.name}: array {name!r} has no storage chunk that ends after "
            f"{num_samples} samples; it was not written by this release"
        )
    digest = hashlib.sha256()
    for row in rows[:num_kept]:
        payload = read_payload(stage, name, row)[:-CRC_BYTES]
        if entry.codec == "zstd":
            values = decode_rows(payload, entry, what=f"{stage.name}: array {name!r}")
            payload = values[: int(row["num_rows"])].tobytes()
        digest.update(payload)
    log = JournalWriter(stage, name, num_rows=num_kept)
    try:
        finish_shard(stage, name, entry, log)
    finally:
        log.close()
    return with_rows(entry, num_samples).model_copy(update={"sha256": digest.hexdigest()})


def _as_recovered(attributes: Attributes, is_taken: IsTaken) -> Attributes:
    """The attributes marked as recovered, under another id if theirs was taken meanwhile."""
    kind, item_id = kind_of(attributes), attributes_id(attributes)
    if is_taken(kind, item_id):
        item_id = free_id(kind, item_id, "recovered", is_taken)
    return attributes.model_copy(update={f"{kind}_id": item_id, "recovered": True})


def free_id(kind: Kind, item_id: str, label: str, is_taken: IsTaken) -> str:
    """The first id `ID-LABEL-1`, `ID-LABEL-2` … that is not in use."""
    names = (f"{item_id[:112]}-{label}-{number}" for number in count(1))
    return next(name for name in names if not is_taken(kind, name))
