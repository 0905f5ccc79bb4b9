"""Latency of small numeric appends to the spool, median and tail."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.figures import Figure
from benchmarks.rounds import interleaved
from benchmarks.stages import Bar
from benchmarks.store.our_design import descriptors
from benchmarks.store.workload import Workload
from dextouch.episodes.spool import SpoolWriter
from dextouch.schemas import RecordingAttributes
from dextouch.streams import NO_DEVICE_TIME, SampleBatch

STREAM = "tactile_left"
SPOOL, SPOOL_SYNCED, ZARR = "spool", "spool, on the disk", "zarr append"
# Lower bound for any log: the same bytes written and synced to a file.
DISK = "bare write and fdatasync"
# Slow methods get fewer appends, so that all take about the same time.
_NUM_APPENDS = {SPOOL: 4000, SPOOL_SYNCED: 1000, DISK: 1000, ZARR: 300}


@dataclass(frozen=True)
class AppendResult:
    """Milliseconds per append of one glove sample; figures hold one value per round."""

    name: str
    num_appends: int
    p50_ms: Figure
    p99_ms: Figure


def measure_appends(
    workload: Workload, folder: Path, num_rounds: int, bar: Bar, *, share: float = 1.0
) -> list[AppendResult]:
    """Append samples of the left glove one by one to the spool, with and without sync.

    Compared with plain file writes, and with a zarr array; `share` is that of the usual number of
    appends.
    """
    ways: dict[str, Callable[[Workload, Path, int], np.ndarray]] = {
        SPOOL: partial(_spool, sync=False),
        SPOOL_SYNCED: partial(_spool, sync=True),
        DISK: _bare,
        ZARR: _zarr,
    }
    counts = {name: max(100, round(share * _NUM_APPENDS[name])) for name in ways}

    def once(name: str, round_index: int) -> np.ndarray:
        path = folder / f"{name.replace(' ', '-').replace(',', '')}-{round_index}"
        return ways[name](workload, path, counts[name])

    with bar("appending", num_rounds * len(ways)) as step:
        taken_ms = interleaved({n: partial(once, n) for n in ways}, num_rounds, on_step=step)
    return [
        AppendResult(
            name,
            counts[name],
            Figure.of([float(np.percentile(rows, 50)) for rows in rounds]),
            Figure.of([float(np.percentile(rows, 99)) for rows in rounds]),
        )
        for name, rounds in taken_ms.items()
    ]


def _spool(workload: Workload, folder: Path, count: int, *, sync: bool) -> np.ndarray:
    streams = tuple(d for d in descriptors(workload, "jpeg") if d.name == STREAM)
    attributes = RecordingAttributes(
        recording_id="appends",
        task="bench",
        instruction="measure the spool",
        domain="robot",
        station="bench",
        streams=streams,
    )
    values = workload.numbers[STREAM].values
    batches = [_batch(values, index) for index in range(count)]
    with SpoolWriter(folder, attributes, sync=sync) as spool:

        def append(index: int) -> None:
            spool.append(STREAM, batches[index])
            spool.flush()

        return _taken_ms(append, count)


def _batch(values: np.ndarray, index: int) -> SampleBatch:
    row = index % len(values)
    return SampleBatch(
        t_host_ns=np.array([index], dtype=np.int64),
        t_device_ns=np.array([NO_DEVICE_TIME], dtype=np.int64),
        sequence=np.array([index], dtype=np.int64),
        values=values[row : row + 1],
    )


def _bare(workload: Workload, folder: Path, count: int) -> np.ndarray:
    rows = [row.tobytes() for row in workload.numbers[STREAM].values]
    descriptor = os.open(folder, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)

    def append(index: int) -> None:
        os.write(descriptor, rows[index % len(rows)])
        os.fdatasync(descriptor)

    try:
        return _taken_ms(append, count)
    finally:
        os.close(descriptor)


def _zarr(workload: Workload, folder: Path, count: int) -> np.ndarray:
    """A zarr array that grows by one row at a time, in chunks of a second."""
    import zarr

    values = workload.numbers[STREAM].values
    array = zarr.create_array(
        str(folder), shape=(0, *values.shape[1:]), chunks=(60, *values.shape[1:]), dtype="uint16"
    )
    return _taken_ms(lambda index: array.append(values[index % len(values)][None]), count)


def _taken_ms(append: Callable[[int], object], count: int) -> np.ndarray:
    taken_ms = np.empty(count)
    for index in range(count):
        begun_s = time.perf_counter()
        append(index)
        taken_ms[index] = (time.perf_counter() - begun_s) * 1e3
    return taken_ms
