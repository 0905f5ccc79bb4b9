"""Signals of streams reduced to the lowest and highest value per bin of time, for plots."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from dextouch.episodes import EpisodeReader, RecordingReader
from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.streams import StreamDescriptor, pack

Reader = EpisodeReader | RecordingReader
# Limits of one request: signals, and bytes of samples that are read for it.
MAX_SIGNALS = 16
MAX_READ_BYTES = 256 * 2**20
BLOCK_BYTES = 4 * 2**20
INTERVAL = "interval_ms"
MAX = "max"


class SignalsQuery(FrozenModel):
    """Query of signals, a comma-separated list, in `points` bins of [start_ns, stop_ns).

    `STREAM` is the sum of a sample's values, `STREAM.max` the largest of them, `STREAM.K` its value
    K, `STREAM.interval_ms` the time since the sample before.
    """

    names: str = Field(min_length=1, max_length=2000)
    start_ns: int
    stop_ns: int
    points: int = Field(default=600, ge=1, le=4000)


def reduce_signals(reader: Reader, query: SignalsQuery) -> bytes:
    """Lowest and highest values of every signal, float32 [points] as msgpack; NaN without samples.

    Raises:
        UnknownNameError: no such stream.
        InvalidInputError: no such value, an image stream, or an empty span.
        LimitExceededError: too many signals or samples.
    """
    names = list(dict.fromkeys(query.names.split(",")))
    if len(names) > MAX_SIGNALS:
        raise LimitExceededError(
            f"signals: got {len(names)}, expected at most {MAX_SIGNALS}",
            got=len(names),
            expected=MAX_SIGNALS,
        )
    if query.stop_ns <= query.start_ns:
        raise InvalidInputError(
            f"signals: got the span {query.start_ns} … {query.stop_ns}, expected start < stop"
        )
    arrays = {}
    left_bytes = MAX_READ_BYTES
    for name in names:
        stream, _, what = name.partition(".")
        # Refuses unknown streams.
        count = reader.count(stream, query.start_ns, query.stop_ns)
        left_bytes -= 0 if what == INTERVAL else count * reader.streams[stream].sample_bytes()
        if left_bytes < 0:
            raise LimitExceededError(
                f"signals: the span holds more than {MAX_READ_BYTES} bytes of samples; "
                "ask for a shorter time or fewer signals",
                expected=MAX_READ_BYTES,
            )
        low, high = _reduced(reader, stream, what, query)
        arrays[f"{name}/low"], arrays[f"{name}/high"] = low, high
    return pack({"start_ns": query.start_ns, "stop_ns": query.stop_ns}, arrays)


def _reduced(
    reader: Reader, stream: str, what: str, query: SignalsQuery
) -> tuple[np.ndarray, np.ndarray]:
    low = np.full(query.points, np.inf)
    high = np.full(query.points, -np.inf)
    span_ns = query.stop_ns - query.start_ns
    for t_ns, values in _blocks(reader, stream, what, query):
        is_known = np.isfinite(values)
        bins = ((t_ns - query.start_ns)[is_known] * (query.points / span_ns)).astype(np.int64)
        bins = np.minimum(bins, query.points - 1)
        np.minimum.at(low, bins, values[is_known])
        np.maximum.at(high, bins, values[is_known])
    is_empty = low > high
    low[is_empty] = high[is_empty] = np.nan
    return low.astype(np.float32), high.astype(np.float32)


def _blocks(
    reader: Reader, stream: str, what: str, query: SignalsQuery
) -> Iterator[tuple[np.ndarray, Float64[np.ndarray, " n"]]]:
    """Stamps and values of a signal in the span, a few MiB of samples at a time."""
    stamps_ns = reader.stamps_ns(stream)
    first, stop = (int(stamps_ns.searchsorted(t)) for t in (query.start_ns, query.stop_ns))
    if what == INTERVAL:
        before = max(first, 1)
        yield stamps_ns[before:stop], np.diff(stamps_ns[before - 1 : stop]) / 1e6
        return
    descriptor = reader.streams[stream]
    reduced = _reduction(descriptor, what)
    rows = max(1, BLOCK_BYTES // descriptor.sample_bytes())
    for low in range(first, stop, rows):
        high = min(low + rows, stop)
        samples = reader.values(stream, low, high).reshape(high - low, -1).astype(np.float64)
        yield stamps_ns[low:high], reduced(samples)


def _reduction(descriptor: StreamDescriptor, what: str) -> Callable[[np.ndarray], np.ndarray]:
    """The signal of flat samples [n, size]."""
    size = int(np.prod(descriptor.shape))
    if descriptor.kind == "image":
        raise InvalidInputError(
            f"signal {descriptor.name}: is an image stream, whose only signal is "
            f"{descriptor.name}.{INTERVAL}"
        )
    if not what:
        return lambda samples: samples.sum(axis=1)
    if what == MAX:
        return lambda samples: samples.max(axis=1)
    if not (what.isdecimal() and what.isascii() and len(what) < 7 and int(what) < size):
        raise InvalidInputError(
            f"signal {descriptor.name}: got {what[:40]!r}, expected {INTERVAL}, {MAX} or an index "
            f"in 0 … {size - 1}"
        )
    index = int(what)
    return lambda samples: samples[:, index]
