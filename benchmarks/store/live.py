"""Live recording of a station at a multiple of real time, to measure lag and drops."""

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.store.our_design import arrivals, descriptors
from benchmarks.store.workload import Workload
from dextouch.episodes import EpisodeStore
from dextouch.schemas import RecordingAttributes

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
