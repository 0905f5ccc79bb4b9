"""Time, size and image error of storage designs, latency of appends, and a live recording."""

import gc
import os
import resource
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.figures import Figure, interleaved
from benchmarks.stages import Bar
from benchmarks.store.designs import (
    Design,
    OpenStore,
    StoreWindow,
    StreamStore,
    arrivals,
    descriptors,
)
from benchmarks.store.workload import CAMERAS, WINDOW_IMAGES, WINDOW_TACTILE, Workload
from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import CorruptDataError
from dextouch.metrics.image import psnr
from dextouch.schemas import RecordingAttributes
from dextouch.streams import NO_DEVICE_TIME, SampleBatch

# Just enough for one window.
_WARM_SECONDS = 0.6


@dataclass(frozen=True)
class Effort:
    """Extent of the measurement: rounds, random windows per round, spans of compared images."""

    num_rounds: int
    num_windows: int
    num_compared: int
    seed: int


@dataclass(frozen=True)
class DesignResult:
    """Cost and image quality of one design; figures hold one value per round."""

    name: str
    seconds: float
    write_s: Figure
    cpu_s: Figure
    num_bytes: int
    num_files: int
    psnr_db: Mapping[str, float]
    window_ms: Figure
    three_cameras_ms: Figure
    three_cameras_threaded_ms: Figure
    touch_ms: Figure | None

    @property
    def mean_psnr_db(self) -> float:
        """Mean over the cameras."""
        return float(np.mean(list(self.psnr_db.values())))


class WriteCost(NamedTuple):
    """One write of the whole take."""

    wall_s: float
    cpu_s: float


class ReadCost(NamedTuple):
    """Milliseconds for one window, three cameras' windows in turn and in threads, and touch."""

    window_ms: float
    three_cameras_ms: float
    three_cameras_threaded_ms: float
    touch_ms: float | None


def compare(
    designs: Sequence[Design], workload: Workload, folder: Path, effort: Effort, bar: Bar
) -> dict[str, DesignResult]:
    """Write and read one take with every design in each round.

    A design that reads another's files requires that other; each has a subfolder. Raises
    CorruptDataError if a design returned other values than were written.
    """
    written = _write_rounds(designs, workload, folder, effort.num_rounds, bar)
    readers = {d.name: d.open(folder / (d.reads or d.name)) for d in designs}
    errors: dict[str, dict[str, float]] = {}
    with bar("comparing with the original", len(readers)) as step:
        for name, reader in readers.items():
            step(name)
            errors[name] = image_psnr(name, reader, workload, effort.num_compared)
    starts = _random_starts(workload, effort)
    with bar("reading windows", effort.num_rounds * len(readers)) as step:
        read = interleaved(
            {name: partial(_read_once, reader, starts) for name, reader in readers.items()},
            effort.num_rounds,
            on_step=step,
        )
    results = {}
    for design in designs:
        files = folder / (design.reads or design.name)
        costs = written[design.reads or design.name]
        results[design.name] = DesignResult(
            name=design.name,
            seconds=workload.seconds,
            write_s=Figure.of([cost.wall_s for cost in costs]),
            cpu_s=Figure.of([cost.cpu_s for cost in costs]),
            num_bytes=sum(p.stat().st_size for p in files.rglob("*") if p.is_file()),
            num_files=sum(p.is_file() for p in files.rglob("*")),
            psnr_db=errors[design.name],
            **_read_figures(read[design.name]),
        )
    return results


def image_psnr(
    name: str, reader: OpenStore, workload: Workload, num_spans: int
) -> dict[str, float]:
    """Mean PSNR of each camera over spans of the take; numeric values must be exact.

    Raises CorruptDataError for other values, or images of another shape, than were written.
    """
    spans = np.linspace(0, workload.num_starts - 1, num_spans + 2).astype(int)[1:-1]
    psnr_db = {}
    for camera in CAMERAS:
        found = []
        for start in (int(span) for span in spans):
            window = reader.window(camera, start)
            true = expected_window(workload, camera, start)
            _check_numbers(name, window, true, start)
            found.append(psnr(predicted=np.asarray(window.images), true=true.images))
        psnr_db[camera] = float(np.mean(found))
    return psnr_db


def expected_window(workload: Workload, camera: str, start: int) -> StoreWindow:
    """The original window."""
    touched = slice(2 * start, 2 * start + WINDOW_TACTILE)
    seen = slice(start, start + WINDOW_IMAGES)
    return StoreWindow(
        images=workload.images[camera].values[seen],
        tactile_left=workload.numbers["tactile_left"].values[touched],
        tactile_right=workload.numbers["tactile_right"].values[touched],
        actions=workload.numbers["action"].values[seen],
    )


def _check_numbers(name: str, window: StoreWindow, true: StoreWindow, start: int) -> None:
    for part in ("tactile_left", "tactile_right", "actions"):
        got, expected = getattr(window, part), getattr(true, part)
        if not np.array_equal(got, expected):
            raise CorruptDataError(
                f"design {name!r}: {part} of the window at image {start} are {got.dtype} "
                f"{got.shape} that differ from the written {expected.dtype} {expected.shape}; "
                "its other figures would be meaningless"
            )


def _write_rounds(
    designs: Sequence[Design], workload: Workload, folder: Path, num_rounds: int, bar: Bar
) -> dict[str, list[WriteCost]]:
    writers = [design for design in designs if design.reads is None]
    with bar("warming up", len(writers)) as step:
        for design in writers:
            step(design.name)
            warm = folder / f"warm-{design.name}"
            design.write(workload.first(_WARM_SECONDS), warm)
            design.open(warm).window(CAMERAS[0], 0)
            shutil.rmtree(warm)
    with bar("writing", num_rounds * len(writers)) as step:
        return interleaved(
            {d.name: partial(_write_once, d, workload, folder / d.name) for d in writers},
            num_rounds,
            on_step=step,
        )


def _write_once(design: Design, workload: Workload, folder: Path, _round_index: int) -> WriteCost:
    shutil.rmtree(folder, ignore_errors=True)
    # Pending writes of the previous design must not be charged to this one.
    os.sync()
    gc.collect()
    cpu_s, wall_s = _cpu_s(), time.perf_counter()
    design.write(workload, folder)
    return WriteCost(wall_s=time.perf_counter() - wall_s, cpu_s=_cpu_s() - cpu_s)


def _cpu_s() -> float:
    """Processor time of this process with all threads, and of its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


Starts = list[list[tuple[str, int]]]


def _random_starts(workload: Workload, effort: Effort) -> Starts:
    """Cameras and starts, the same for all designs of a round."""
    rng = np.random.default_rng(effort.seed)
    return [
        [
            (CAMERAS[int(rng.integers(len(CAMERAS)))], int(rng.integers(workload.num_starts)))
            for _ in range(effort.num_windows)
        ]
        for _ in range(effort.num_rounds)
    ]


def _read_once(reader: OpenStore, all_starts: Starts, round_index: int) -> ReadCost:
    starts = all_starts[round_index]
    few = [start for _, start in starts[: max(1, len(starts) // 4)]]
    for camera in CAMERAS:
        reader.window(camera, starts[0][1])
    return ReadCost(
        window_ms=_mean_ms([partial(reader.window, *place) for place in starts]),
        three_cameras_ms=_mean_ms(
            [partial(reader.windows, CAMERAS, start, threaded=False) for start in few]
        ),
        three_cameras_threaded_ms=_mean_ms(
            [partial(reader.windows, CAMERAS, start, threaded=True) for start in few]
        ),
        touch_ms=_mean_ms([partial(reader.touch, start) for _, start in starts])
        if isinstance(reader, StreamStore)
        else None,
    )


def _mean_ms(calls: Sequence[Callable[[], object]]) -> float:
    gc.collect()
    begun_s = time.perf_counter()
    for call in calls:
        call()
    return (time.perf_counter() - begun_s) * 1e3 / len(calls)


def _read_figures(costs: Sequence[ReadCost]) -> dict[str, Any]:
    columns = zip(ReadCost._fields, zip(*costs, strict=True), strict=True)
    return {name: None if None in values else Figure.of(values) for name, values in columns}


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


SPEED = 4.0
# A station's queues cover this time; a row that waits longer for the store is late.
LATE_S = 0.1
_RECORDING_ID = "live"


@dataclass(frozen=True)
class LiveResult:
    """Result of one paced run.

    `num_late` rows were accepted more than LATE_S late, `num_dropped` ones are missing from
    the recording; `finish_s` is the time from the last row to the committed recording.
    """

    speed: float
    num_rows: int
    num_late: int
    num_dropped: int
    worst_lag_ms: float
    finish_s: float


def write_live(workload: Workload, folder: Path) -> LiveResult:
    """Write a recording of the whole station with H.264 at a multiple of real time.

    The timestamps of the take are the due times; the folder of the store is emptied first.
    """
    shutil.rmtree(folder, ignore_errors=True)
    attributes = RecordingAttributes(
        recording_id=_RECORDING_ID,
        task="bench",
        instruction="keep up",
        domain="robot",
        station="bench",
        streams=descriptors(workload, "h264"),
    )
    store = EpisodeStore(folder)
    num_rows, num_late, worst_lag_s = 0, 0, 0.0
    with store.writer(kind="recording", attributes=attributes) as writer:
        begun_s = time.perf_counter()
        for name, values, stamps in arrivals(workload):
            if not len(stamps):
                continue
            due_s = begun_s + int(stamps[-1]) / 1e9 / SPEED
            time.sleep(max(0.0, due_s - time.perf_counter()))
            writer.append(
                name,
                values=values,
                t_host_ns=stamps,
                t_device_ns=stamps,
                sequence=np.arange(len(stamps), dtype=np.int64),
            )
            lag_s = time.perf_counter() - due_s
            num_rows += len(stamps)
            num_late += len(stamps) if lag_s > LATE_S else 0
            worst_lag_s = max(worst_lag_s, lag_s)
        ended_s = time.perf_counter()
    finish_s = time.perf_counter() - ended_s
    kept = store.recording(_RECORDING_ID)
    num_kept = sum(kept.num_samples(name) for name in kept.streams)
    return LiveResult(SPEED, num_rows, num_late, num_rows - num_kept, worst_lag_s * 1e3, finish_s)
