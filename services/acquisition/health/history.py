"""History of a station's health: a row a second of the last hour, in ring buffers of fixed size.

Its memory is taken at the start and never grows: 44 bytes a stream and second, which is 1.6 MB an
hour for ten streams.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float32, Int64
from pydantic_core import to_json

from dextouch.errors import UnknownNameError
from dextouch.schemas import TakeSpan
from dextouch.streams import StreamDescriptor, pack
from services.acquisition.drivers.packets import DecoderStatistics
from services.acquisition.health.codes import CODES
from services.acquisition.health.evaluation import Block
from services.acquisition.health.streams import GAP_PERIODS

NUM_ROWS = 3600
MAX_TAKES = 500
STREAM_SERIES: Final = {
    "level": "0 OK, 1 WARN, 2 ERROR, 3 STALE.",
    "rate_hz": "Samples a second.",
    "gap_ratio": "Share of the second within gaps, as the code `gap` defines them.",
    "interval_p95_s": "95th percentile of the intervals that ended in the second.",
    "interval_max_s": "Longest interval that ended in the second.",
    "age_s": "Age of the newest sample at the end of the second.",
    "loss_ratio": "Packets of the device lost by sequence number.",
    "clock_offset_s": "Time of the host minus that of the device, since its first sample.",
    "clock_skew_ppm": "How much faster the host's clock runs than the device's.",
    "clock_residual_s": "95 % of the arrivals of 10 s lie closer to the fitted clock's median.",
    "buffer_ratio": "Fill of the buffer of 4 s in which samples wait for the evaluation.",
}
STATION_SERIES: Final = {
    "level": "0 OK, 1 WARN, 2 ERROR, 3 STALE.",
    "cpu_ratio": "Share of the processors' time that was used.",
    "wake_p90_s": "90th percentile of 10 s of how late a thread of the station wakes.",
    "disk_free_bytes": "Free bytes on the disk of the takes.",
    "disk_left_s": "How long that disk lasts at the present rate.",
}
# Series that are figures of the evaluation: by which name, and in which unit.
STREAM_FIGURES: Final = {
    "clock_offset_s": ("clock_offset_seconds", 1.0),
    "clock_skew_ppm": ("clock_skew_ratio", 1e6),
    "clock_residual_s": ("clock_residual_p95_seconds", 1.0),
}
STATION_FIGURES: Final = {
    "cpu_ratio": "host_cpu_ratio",
    "wake_p90_s": "host_wake_p90_seconds",
    "disk_free_bytes": "disk_free_bytes",
    "disk_left_s": "disk_left_seconds",
}


class Rows(NamedTuple):
    """Consecutive rows; NaN where a value is unknown.

    The second axis of `values` are `STREAM_SERIES`, the first of `station` are `STATION_SERIES`.
    """

    t_ns: Int64[np.ndarray, " rows"]
    station: Float32[np.ndarray, "station_series rows"]
    values: Float32[np.ndarray, "streams series rows"]
    streams: tuple[str, ...]


class StreamMeter:
    """Measures one stream from one row of the history to the next."""

    def __init__(
        self,
        statistics: Callable[[], DecoderStatistics],
        descriptor: StreamDescriptor,
        capacity: int,
    ) -> None:
        self._statistics = statistics
        self._rate_hz = descriptor.nominal_rate_hz
        self._capacity = capacity
        shortest_ns = GAP_PERIODS * descriptor.period_ns()
        self._gap_ns = max(round(CODES["gap"].warn * 1e9), shortest_ns)
        self._blocks: list[Int64[np.ndarray, " n"]] = []
        self._begin_ns: int | None = None
        self._last_ns: int | None = None
        self._phase = 0.0
        self._counts = (0, 0)
        self._largest_block = 0

    def add(self, block: Block) -> None:
        """Samples of one evaluation."""
        if len(block):
            self._blocks.append(block.t_host_ns)
        self._largest_block = max(self._largest_block, len(block))

    def row(self, now_ns: int, level: int, figures: Mapping[str, float]) -> dict[str, float]:
        """What was measured since the last row, by series; what is unknown is left out."""
        t_ns = np.concatenate([np.empty(0, dtype=np.int64), *self._blocks])
        row = {"level": float(level), "buffer_ratio": self._largest_block / self._capacity}
        statistics, counts = self._statistics(), self._counts
        self._counts = statistics.packets, statistics.lost
        num_packets, num_lost = statistics.packets - counts[0], max(0, statistics.lost - counts[1])
        if offered := num_packets + num_lost:
            row["loss_ratio"] = num_lost / offered
        last_ns = int(t_ns[-1]) if len(t_ns) else self._last_ns
        # A sample that is due counts in part, so that rates are not rounded to whole samples.
        phase = 0.0
        if last_ns is not None:
            phase = min(1.0, (now_ns - last_ns) * 1e-9 * self._rate_hz)
            row["age_s"] = max(0, now_ns - last_ns) * 1e-9
        if self._begin_ns is not None and now_ns > self._begin_ns:
            num_samples = max(0.0, len(t_ns) + phase - self._phase)
            row["rate_hz"] = num_samples / ((now_ns - self._begin_ns) * 1e-9)
            row |= self._arrivals(t_ns, self._begin_ns, now_ns)
        for name, (figure, factor) in STREAM_FIGURES.items():
            if len(t_ns) and figure in figures:
                row[name] = factor * figures[figure]
        self._begin_ns, self._last_ns, self._phase = now_ns, last_ns, phase
        self._blocks, self._largest_block = [], 0
        return row

    def _arrivals(self, t_ns: np.ndarray, begin_ns: int, now_ns: int) -> dict[str, float]:
        """Intervals that ended, and the time in gaps, also in one that still lasts."""
        before_ns = begin_ns if self._last_ns is None else self._last_ns
        edges_ns = np.concatenate([[before_ns], t_ns, [now_ns]])
        steps_ns = np.diff(edges_ns)
        starts_ns, stops_ns = np.maximum(edges_ns[:-1], begin_ns), np.minimum(edges_ns[1:], now_ns)
        in_gaps_ns = np.maximum(0, stops_ns - starts_ns)[steps_ns > self._gap_ns].sum()
        found = {"gap_ratio": float(in_gaps_ns) / (now_ns - begin_ns)}
        ended_s = steps_ns[0 if self._last_ns is not None else 1 : -1] * 1e-9
        if len(ended_s):
            found["interval_p95_s"] = float(np.percentile(ended_s, 95))
            found["interval_max_s"] = float(ended_s.max())
        return found


class HealthHistory:
    """The newest rows of the station and its streams, and the newest takes; for any thread."""

    def __init__(self, streams: Sequence[str], num_rows: int = NUM_ROWS) -> None:
        self.streams = tuple(streams)
        shape = (len(streams), len(STREAM_SERIES), num_rows)
        self._t_ns = np.zeros(num_rows, dtype=np.int64)
        self._values = np.full(shape, np.nan, dtype=np.float32)
        self._station = np.full((len(STATION_SERIES), num_rows), np.nan, dtype=np.float32)
        self._num_added = 0
        self._takes: deque[TakeSpan] = deque(maxlen=MAX_TAKES)
        self._lock = threading.Lock()

    @property
    def num_bytes(self) -> int:
        """Memory of all rows."""
        return self._t_ns.nbytes + self._values.nbytes + self._station.nbytes

    def add(
        self, t_ns: int, station: Mapping[str, float], streams: Mapping[str, Mapping[str, float]]
    ) -> None:
        """Add a row at a time on the station's clock; series that are left out are unknown."""
        nan = np.nan
        values = [[streams[name].get(key, nan) for key in STREAM_SERIES] for name in self.streams]
        with self._lock:
            ring_index = self._num_added % len(self._t_ns)
            self._t_ns[ring_index] = t_ns
            self._station[:, ring_index] = [station.get(key, nan) for key in STATION_SERIES]
            self._values[:, :, ring_index] = np.reshape(values, self._values.shape[:2])
            self._num_added += 1

    def rows(
        self, streams: Sequence[str] = (), *, since_ns: int = 0, limit: int = NUM_ROWS
    ) -> Rows:
        """The newest `limit` rows from `since_ns` on, oldest first; of all streams by default.

        Raises:
            UnknownNameError: no such stream.
        """
        chosen = tuple(streams) or self.streams
        unknown = [name for name in chosen if name not in self.streams]
        if unknown:
            raise UnknownNameError("stream", unknown[0], list(self.streams))
        indices = [self.streams.index(name) for name in chosen]
        with self._lock:
            first = max(0, self._num_added - len(self._t_ns))
            ring_indices = np.arange(first, self._num_added) % len(self._t_ns)
            ring_indices = ring_indices[self._t_ns[ring_indices] >= since_ns][-limit:]
            values = self._values[indices][:, :, ring_indices]
            return Rows(self._t_ns[ring_indices], self._station[:, ring_indices], values, chosen)

    def begin_take(self, recording_id: str, start_ns: int) -> None:
        """A take has begun."""
        with self._lock:
            self._takes.append(TakeSpan(recording_id=recording_id, start_ns=start_ns))

    def end_take(self, recording_id: str, stop_ns: int) -> None:
        """A take has ended; the first end counts."""
        with self._lock:
            for index, take in enumerate(self._takes):
                if take.recording_id == recording_id and take.stop_ns is None:
                    self._takes[index] = take.model_copy(update={"stop_ns": stop_ns})

    def takes(self, since_ns: int = 0) -> tuple[TakeSpan, ...]:
        """Takes that ended after a moment, or run, oldest first."""
        with self._lock:
            return tuple(t for t in self._takes if t.stop_ns is None or t.stop_ns >= since_ns)


def encoded_history(
    rows: Rows,
    now_ns: int,
    takes: tuple[TakeSpan, ...],
    nominal_rate_hz: Mapping[str, float],
    *,
    packed: bool,
) -> bytes:
    """A history (`dextouch.schemas.HealthHistory`) as JSON, null where a value is unknown.

    Packed, the arrays `t_ns`, `station` and `streams` stand beside the other fields.
    """
    facts: dict[str, object] = {
        "now_ns": now_ns,
        "now_unix_s": time.time(),
        "takes": [take.model_dump() for take in takes],
        "nominal_rate_hz": dict(nominal_rate_hz),
        "station_series": list(STATION_SERIES),
        "stream_series": list(STREAM_SERIES),
    }
    if packed:
        return pack(facts, {"t_ns": rows.t_ns, "station": rows.station, "streams": rows.values})
    streams = dict(zip(rows.streams, rows.values.tolist(), strict=True))
    body = {"t_ns": rows.t_ns.tolist(), "station": rows.station.tolist(), "streams": streams}
    return to_json(facts | body, inf_nan_mode="null")
