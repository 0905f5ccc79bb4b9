"""Writer of one array: appends rows to a log, which closing turns into a Zarr v3 shard file."""

import hashlib
from pathlib import Path

import google_crc32c
import numpy as np

from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import ArrayEntry, shard_path, with_rows
from dextouch.episodes.journal import (
    JournalWriter,
    part_path,
    read_payload,
    read_rows,
)
from dextouch.episodes.shard_reader import CRC_BYTES, decode_rows, with_crc
from dextouch.episodes.zstd import compress


class ShardWriter:
    """Appends rows; buffers at most one storage chunk, everything before survives a kill.

    The entry of the array has 0 rows and no hash yet. With `sync`, `append` waits until complete
    storage chunks are synced to disk.
    """

    def __init__(self, stage: Path, name: str, entry: ArrayEntry, *, sync: bool) -> None:
        self.num_rows = 0
        self._stage, self._name, self._entry, self._sync = stage, name, entry, sync
        self._dtype = np.dtype(entry.dtype).newbyteorder("<")
        self._chunk = (
            np.zeros((entry.chunk_rows, *entry.shape[1:]), dtype=self._dtype)
            if entry.codec == "zstd"
            else np.zeros(0, dtype=self._dtype)
        )
        self._num_pending = 0
        self._sha256 = hashlib.sha256()
        self._log = JournalWriter(stage, name)

    def append(self, rows: np.ndarray) -> None:
        """Append rows [n, *row_shape] of the array's dtype (checked by the caller)."""
        self.num_rows += len(rows)
        while len(rows):
            taken = rows[: len(self._chunk) - self._num_pending]
            self._chunk[self._num_pending : self._num_pending + len(taken)] = taken
            self._num_pending += len(taken)
            rows = rows[len(taken) :]
            if self._num_pending == len(self._chunk):
                self._write_rows()

    def append_encoded(self, payload: bytes, num_rows: int) -> None:
        """Append one encoded storage chunk of an image codec."""
        self.num_rows += num_rows
        self._sha256.update(payload)
        self._log_chunk(payload, num_rows)

    def flush(self) -> None:
        """Write the last, partial storage chunk; nothing may be appended afterwards."""
        if self._num_pending:
            self._chunk[self._num_pending :] = 0
            self._write_rows()

    def flush_until(self, num_rows: int) -> None:
        """Truncate the log of a `zstd` array to `num_rows` rows after an interrupted append.

        Relies on the log only: an interrupt may fall between a write and its bookkeeping.
        """
        if self._entry.codec != "zstd":
            return
        rows = read_rows(self._stage, self._name)
        ends = np.cumsum(rows["num_rows"], dtype=np.int64)
        num_whole = int(np.searchsorted(ends, num_rows, side="right"))
        chunk = self._chunk
        if num_whole < len(rows):
            # Rows of the interrupted append completed this storage chunk.
            payload = read_payload(self._stage, self._name, rows[num_whole])
            chunk = decode_rows(payload[:-CRC_BYTES], self._entry, what=self._name).copy()
        self._log.truncate(num_whole)
        num_waiting = num_rows - (int(ends[num_whole - 1]) if num_whole else 0)
        if num_waiting:
            chunk[num_waiting:] = 0
            self._log.append(with_crc(compress(chunk.tobytes())), num_waiting)

    def finish(self) -> ArrayEntry:
        """Turn the log into the shard and return the array's entry of the commit record."""
        self.flush()
        finish_shard(self._stage, self._name, self._entry, self._log)
        entry = with_rows(self._entry, self.num_rows)
        return entry.model_copy(update={"sha256": self._sha256.hexdigest()})

    def close(self) -> None:
        """Close the files; without a prior `finish` they remain a log."""
        self._log.close()

    def _write_rows(self) -> None:
        data = self._chunk.tobytes()
        num_rows = self._num_pending
        self._log_chunk(compress(data), num_rows)
        self._sha256.update(memoryview(data)[: num_rows * (len(data) // len(self._chunk))])
        self._num_pending = 0

    def _log_chunk(self, payload: bytes, num_rows: int) -> None:
        self._log.append(with_crc(payload), num_rows)
        if self._sync:
            self._log.sync()


def finish_shard(stage: Path, name: str, entry: ArrayEntry, log: JournalWriter) -> None:
    """Append the shard's index to a log's part file and rename it to the shard.

    The journal is kept until the whole group is committed, for recovery after a crash.
    """
    data = np.array(log.index, dtype="<u8").reshape(-1, 2).tobytes()
    log.write_tail(data + google_crc32c.value(data).to_bytes(4, "little"))
    log.close()
    target = stage / name / shard_path(len(entry.shape))
    with disk_errors(f"close array {name}"):
        target.parent.mkdir(parents=True, exist_ok=True)
        part_path(stage, name).rename(target)
