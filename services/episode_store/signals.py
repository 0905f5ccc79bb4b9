"""Signals of streams reduced to the lowest and highest value per bin of time, for plots."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from dextouch.episodes import EpisodeReader, RecordingReader
from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import ClockReport, EpisodeAttributes, Finding, RecordingAttributes
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


# Figures of an item's quality by which the items of a task are compared.


@dataclass(frozen=True)
class Figure:
    """A figure that all items may have.

    `resolution` is the smallest spread that matters: a task whose items hardly differ must not make
    outliers of differences that nobody would look at. `unit` "%" is shown of a share.
    """

    name: str
    label: str
    unit: str
    bad: Literal["high", "low", "both"]
    resolution: float

    def text(self, value: float) -> str:
        """The value as an operator reads it."""
        return f"{100 * value:.1f} %" if self.unit == "%" else f"{value:.3g} {self.unit}".rstrip()


FIGURES: Final = (
    Figure("duration_s", "duration", "s", "both", 0.25),
    Figure("coverage", "share of steps kept", "%", "low", 0.01),
    Figure("clock_residual_ms", "clock residual", "ms", "high", 0.1),
    Figure("num_gaps", "gaps", "", "high", 1.0),
    Figure("largest_gap_s", "largest gap", "s", "high", 0.02),
    Figure("lost_share", "samples lost", "%", "high", 0.002),
    Figure("tip_error_mm", "fingertip error of retargeting", "mm", "high", 0.5),
    Figure("peak_speed_m_s", "peak speed of a wrist", "m/s", "both", 0.1),
    Figure("jerk_p95_m_s3", "jerk of a wrist", "m/s³", "high", 5.0),
    Figure("static_share", "share of time at rest", "%", "both", 0.02),
)
# Figures that are made of those of single streams or hands: their names, and how.
_COLLECTED: Final[Mapping[str, tuple[str, Callable[[Iterable[float]], float]]]] = {
    "num_gaps": (r".+_num_gaps", sum),
    "largest_gap_s": (r".+_largest_gap_s", max),
    "tip_error_mm": (r"retargeting_.+_tip_error_p95_mm", max),
    "peak_speed_m_s": (r"(.+_)?peak_speed_m_s", max),
    "jerk_p95_m_s3": (r"(.+_)?jerk_p95_m_s3", max),
    "static_share": (r"static_share", min),
}


def figures_of(
    attributes: EpisodeAttributes | RecordingAttributes, *, num_steps: int, duration_s: float
) -> dict[str, float]:
    """The figures that an item has; `num_steps` are those of an episode."""
    quality = attributes.quality
    found = {"duration_s": duration_s}
    for name, (pattern, collect) in _COLLECTED.items():
        values = [value for key, value in quality.items() if re.fullmatch(pattern, key)]
        if values:
            found[name] = float(collect(values))
    if "coverage" in quality:
        found["coverage"] = quality["coverage"]
    elif num_steps and "num_steps_refused" in quality:
        found["coverage"] = num_steps / (num_steps + quality["num_steps_refused"])
    if isinstance(attributes, EpisodeAttributes):
        found |= _clock_figures(attributes.clocks)
    return found


def _clock_figures(clocks: Iterable[ClockReport]) -> dict[str, float]:
    found = {}
    residuals_ms = [one.residual_rms_ms for one in clocks if one.residual_rms_ms is not None]
    if residuals_ms:
        found["clock_residual_ms"] = max(residuals_ms)
    dropped = sum(clock.num_dropped for clock in clocks)
    offered = dropped + sum(clock.num_samples for clock in clocks)
    if offered:
        found["lost_share"] = dropped / offered
    return found


# Outliers among items of the same task, by robust z-scores of their figures.
#
# The score is 0.6745 (x − median) / MAD, and items above 3.5 are outliers (Iglewicz and Hoaglin,
# How to Detect and Handle Outliers, 1993).

# MAD of a normal distribution with standard deviation 1 (Iglewicz and Hoaglin, section 3.3).
MAD_OF_SIGMA: Final = 0.6745
MAX_SCORE: Final = 3.5
# Median and MAD of fewer values say little about what is usual.
MIN_ITEMS: Final = 8


def robust_scores(
    values: Float64[np.ndarray, " n"], *, resolution: float
) -> Float64[np.ndarray, " n"]:
    """Deviations from the median in robust standard deviations, at least `resolution` each."""
    deviations = values - np.median(values)
    sigma = float(np.median(np.abs(deviations))) / MAD_OF_SIGMA
    return deviations / max(sigma, resolution)


def find_outliers(items: Sequence[Mapping[str, float]]) -> list[list[Finding]]:
    """Findings of each item of one task; none where fewer than MIN_ITEMS have a figure."""
    found: list[list[Finding]] = [[] for _ in items]
    for figure in FIGURES:
        owners = [place for place, figures in enumerate(items) if figure.name in figures]
        if len(owners) < MIN_ITEMS:
            continue
        values = np.array([items[place][figure.name] for place in owners])
        scores = robust_scores(values, resolution=figure.resolution)
        for place, value, score in zip(owners, values.tolist(), scores.tolist(), strict=True):
            if _is_outlier(figure, score):
                found[place].append(_finding(figure, value, float(np.median(values)), score))
    return found


def _is_outlier(figure: Figure, score: float) -> bool:
    if figure.bad == "both":
        return abs(score) > MAX_SCORE
    return (score if figure.bad == "high" else -score) > MAX_SCORE


def _finding(figure: Figure, value: float, median: float, score: float) -> Finding:
    text = f"{figure.label} {figure.text(value)}, usually {figure.text(median)}"
    return Finding(
        code="outlier", message=text, figure=figure.name, value=value, median=median, score=score
    )
