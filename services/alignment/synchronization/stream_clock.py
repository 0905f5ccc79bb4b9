"""Clock fit of one recorded stream, which gives each sample a time on the host's clock."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int64

from dextouch.clocks import (
    AHEAD_NS,
    MIN_SAMPLES,
    corrected_stamps,
    count_lost_samples,
    date_by_counting,
    fit_clock,
    lateness_ns,
    prefers_sequence,
    unwrap_counter,
)
from dextouch.errors import ClockFitError, InvalidInputError
from dextouch.schemas import ClockMethod, ClockReport, ClockWarning
from dextouch.streams import NO_DEVICE_TIME, NO_SEQUENCE, SampleBatch, StreamDescriptor
from services.alignment.synchronization.resampling import runs_of

NS_PER_MS = 1e6
MIN_COUNTED_SAMPLES = 60
# Crystals are good to 100 ppm. A nominal rate that stands for a clock may be off by percents.
MAX_SKEW_PPM = 1000.0
MAX_RATE_ERROR_PPM = 20_000.0
# A path's ordinary scatter exceeds the period of a fast stream.
MIN_LATENESS_NS = 5e6
# Stamps are better: all samples of five seconds are later than a USB frame of 1 ms only with a
# wrong fit or a delay that lasts.
MAX_STAMPED_LATENESS_NS = 1e6
# Stamps of another unit are off by a thousand; clocks, rates and losses never by so much.
MIN_UNIT_RATIO = 20.0
# Of the blocks of samples between which a clock may step; chosen: all but one of ten.
MIN_OFF_SHARE = 0.9
# So many blocks in turn show a unit that changes within the take.
MIN_OFF_BLOCKS = 3
UNITS = {
    1e3: "microseconds taken for nanoseconds",
    1e6: "milliseconds taken for nanoseconds",
    1e9: "seconds taken for nanoseconds",
    1e-3: "nanoseconds taken for microseconds",
    1e-6: "nanoseconds taken for milliseconds",
}
# Stamps of consecutive samples that are cut to a step take several multiples of it, each as often.
MIN_CUT_SHARE = 0.01


@dataclass(frozen=True)
class TimedStream:
    """Increasing times of samples `kept` (not repeated) on the host's clock, and their report."""

    kept: Int64[np.ndarray, " n"]
    t_host_ns: Int64[np.ndarray, " n"]
    report: ClockReport


@dataclass(frozen=True)
class _Dated:
    """Times on the host's clock including the path's delay, with facts about the clock."""

    t_host_ns: Int64[np.ndarray, " n"]
    method: ClockMethod
    num_lost: int = 0
    num_steps: int = 0
    skew_ppm: float | None = None
    residual_rms_ms: float | None = None
    lateness_ns: float = 0.0
    has_unsure_stops: bool = False


def time_stream(
    batch: SampleBatch,
    descriptor: StreamDescriptor,
    *,
    latency_ns: int = 0,
    latency_sigma_ns: float | None = None,
) -> TimedStream:
    """Fit the device's clock and compute the time of every sample.

    The device's stamps are used where there are any (unless samples are numbered and the stamps are
    declared or shown to be coarser than a quarter of the period), else its sequence numbers times
    the period, else the count of samples that a steady device must have sent, else the arrivals, as
    of less than ten samples. The calibrated path delay `latency_ns` is taken away; its sigma is
    None if it was not measured. Raises ClockFitError: stamps that no clock gives; names the stream.
    """
    try:
        dated = _dated(batch, descriptor)
    except InvalidInputError as error:
        raise ClockFitError(
            f"stream {descriptor.name!r}: {error.message}", stream=descriptor.name, **error.details
        ) from error
    t_host_ns = dated.t_host_ns - latency_ns
    # A sample not later than one before it is a repeat, or lies at the seam of a clock step.
    latest = np.maximum.accumulate(np.concatenate([t_host_ns[:1] - 1, t_host_ns[:-1]]))
    kept = np.flatnonzero(t_host_ns > latest)
    report = ClockReport(
        stream=descriptor.name,
        method=dated.method,
        skew_ppm=dated.skew_ppm,
        latency_ms=latency_ns / NS_PER_MS,
        latency_sigma_ms=None if latency_sigma_ns is None else latency_sigma_ns / NS_PER_MS,
        residual_rms_ms=dated.residual_rms_ms,
        num_samples=len(kept),
        num_dropped=dated.num_lost + len(batch) - len(kept),
        num_steps=dated.num_steps,
        warnings=_warnings(dated, descriptor.period_ns()),
    )
    return TimedStream(kept, t_host_ns[kept], report)


def _warnings(dated: _Dated, period_ns: int) -> tuple[ClockWarning, ...]:
    skew_limit_ppm, lateness_limit_ns = MAX_RATE_ERROR_PPM, max(period_ns, MIN_LATENESS_NS)
    if dated.method == "device":
        skew_limit_ppm, lateness_limit_ns = MAX_SKEW_PPM, MAX_STAMPED_LATENESS_NS
    warnings: dict[ClockWarning, bool] = {
        "skew": abs(dated.skew_ppm or 0.0) > skew_limit_ppm,
        "residual": dated.lateness_ns > lateness_limit_ns,
        "stop": dated.has_unsure_stops,
    }
    return tuple(name for name, is_so in warnings.items() if is_so)


def _dated(batch: SampleBatch, descriptor: StreamDescriptor) -> _Dated:
    capabilities = descriptor.capabilities
    is_enough = len(batch) >= MIN_SAMPLES
    has_time = is_enough and not (batch.t_device_ns == NO_DEVICE_TIME).any()
    has_sequence = is_enough and not (batch.sequence == NO_SEQUENCE).any()
    period_ns = descriptor.period_ns()
    bits, tick_ns = capabilities.device_time_bits, capabilities.tick_ns
    stamped = numbered = None
    if has_time and not (has_sequence and prefers_sequence(tick_ns, period_ns)):
        device_ns = _unwrap(batch.t_device_ns, bits, tick_ns, batch)
        has_time = _keeps_unit(device_ns, batch.t_host_ns, period_ns, may_change=has_sequence)
    if has_time and not (has_sequence and prefers_sequence(tick_ns, period_ns)):
        stamped = _fitted(device_ns, batch, descriptor, "device")
        # A stamp is cut down to whole ticks: on average the sample lies half a tick later. The fit
        # does not see it, as it hangs on the stamps that were cut least.
        stamped = replace(stamped, t_host_ns=stamped.t_host_ns + tick_ns // 2)
        shown_ns = _shown_tick_ns(device_ns, batch.sequence) if has_sequence else 0
        if not prefers_sequence(shown_ns, period_ns):
            return stamped
    if has_sequence:
        numbers = batch.sequence * period_ns
        device_ns = _unwrap(numbers, capabilities.sequence_bits, period_ns, batch)
        numbered = _fitted(device_ns, batch, descriptor, "sequence")
    # Samples may really lie on the steps that their stamps show, as those that are polled do: then
    # they arrive with their stamps.
    if stamped is not None and numbered is not None:
        scatter_ms = [one.residual_rms_ms or 0.0 for one in (stamped, numbered)]
        return numbered if scatter_ms[1] < scatter_ms[0] else stamped
    if numbered is not None:
        return numbered
    return _counted(batch, period_ns)


def _keeps_unit(
    device_ns: np.ndarray, t_host_ns: np.ndarray, period_ns: int, *, may_change: bool
) -> bool:
    """Refuse stamps of another unit; False where only a part has one, and `may_change`."""
    edges = np.arange(0, len(device_ns), MIN_COUNTED_SAMPLES)
    if len(edges) < 2:
        return True
    device_ns, host_ns = (
        np.diff(times[edges]) / MIN_COUNTED_SAMPLES for times in (device_ns, t_host_ns)
    )
    known = (device_ns > 0) & (host_ns > 0)
    if not known.any():
        return True
    device_ns, host_ns = device_ns[known], host_ns[known]
    ratios = np.stack([period_ns / device_ns, host_ns / device_ns])
    is_off = (ratios > MIN_UNIT_RATIO).all(axis=0) | (ratios < 1 / MIN_UNIT_RATIO).all(axis=0)
    lasts = (
        max((stop - start for start, stop in runs_of(np.asarray(is_off))), default=0)
        >= MIN_OFF_BLOCKS
    )
    if is_off.mean() < MIN_OFF_SHARE and (not lasts or may_change):
        return not lasts
    ratios, device_ns, host_ns = ratios[:, is_off], device_ns[is_off], host_ns[is_off]
    ratio = float(np.median(ratios[0]))
    alike = [what for unit, what in UNITS.items() if 0.5 < ratio / unit < 2]
    hint = f": these look like {alike[0]}" if alike else ""
    raise ClockFitError(
        f"got {np.median(device_ns):.4g} ns between the device's stamps, expected "
        f"{period_ns:.4g} ns (samples arrive every {np.median(host_ns):.4g} ns){hint}; send "
        "stamps in the declared unit (docs/device_packets.md)",
        fault="unit",
    )


def _shown_tick_ns(device_ns: np.ndarray, sequence: np.ndarray) -> int:
    """The step to which stamps are cut, as those of numbered samples show it; 0 where none shows.

    Floats of seconds lose digits as a device's clock runs: after a day, 32 bits leave 8 ms.
    """
    steps_ns = np.diff(device_ns)[np.diff(sequence) == 1]
    if len(steps_ns) < MIN_COUNTED_SAMPLES:
        return 0
    _, counts = np.unique(steps_ns, return_counts=True)
    is_cut = len(counts) > 1 and bool(counts.max() < (1 - MIN_CUT_SHARE) * len(steps_ns))
    return int(np.gcd.reduce(steps_ns)) if is_cut else 0


def _fitted(
    device_ns: np.ndarray, batch: SampleBatch, descriptor: StreamDescriptor, method: ClockMethod
) -> _Dated:
    if method == "device":
        device_ns = corrected_stamps(device_ns, batch.t_host_ns)
    model, num_lost = fit_clock(device_ns, batch.t_host_ns), 0
    if not (batch.sequence == NO_SEQUENCE).any():
        starts = np.flatnonzero(_restarts(batch, descriptor)) + 1
        bits = descriptor.capabilities.sequence_bits
        parts = np.split(batch.sequence, starts)
        num_lost = sum(count_lost_samples(part, bits=bits) for part in parts)
    return _Dated(
        model.to_host_ns(device_ns, batch.t_host_ns),
        method,
        num_lost,
        model.num_steps,
        model.skew_ppm,
        model.residual_rms_ns / NS_PER_MS,
        model.lateness_ns,
        model.has_unsure_stops,
    )


def _restarts(batch: SampleBatch, descriptor: StreamDescriptor) -> Bool[np.ndarray, " steps"]:
    """Whether the number after each sample is far ahead of its arrival: the device began anew."""
    bits, period_ns = descriptor.capabilities.sequence_bits, descriptor.period_ns()
    numbers_ns = _unwrap(batch.sequence * period_ns, bits, period_ns, batch)
    return np.asarray(np.diff(numbers_ns) - np.diff(batch.t_host_ns) > AHEAD_NS)


def _counted(batch: SampleBatch, period_ns: int) -> _Dated:
    """Times by counting samples of a steady device, otherwise arrival times."""
    arrivals = _Dated(batch.t_host_ns, "arrival")
    if len(batch) < MIN_COUNTED_SAMPLES or (np.diff(batch.t_host_ns) < 0).any():
        return arrivals
    take = date_by_counting(batch.t_host_ns, period_ns=period_ns)
    if not take.is_steady:
        return arrivals
    waited_ns = (batch.t_host_ns - take.t_host_ns).astype(np.float64)
    return _Dated(
        take.t_host_ns,
        "counting",
        take.num_lost,
        take.num_steps,
        take.skew_ppm,
        float(np.sqrt(np.mean(waited_ns**2))) / NS_PER_MS,
        lateness_ns(waited_ns, batch.t_host_ns),
    )


def _unwrap(
    counts_ns: np.ndarray, bits: int, unit_ns: int, batch: SampleBatch
) -> Int64[np.ndarray, " n"]:
    if bits * np.log(2) + np.log(unit_ns) > 62 * np.log(2):
        return counts_ns.astype(np.int64)
    return unwrap_counter(counts_ns, modulus=2**bits * unit_ns, hint=batch.t_host_ns)
