"""One stream's stamps in, the times of its samples on the host's clock and a clock report out."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from dextouch.clocks import find_lost_samples, fit_clock, unwrap_counter
from dextouch.errors import ClockFitError
from dextouch.schemas.episodes import ClockReport
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import NO_DEVICE_TIME, NO_SEQUENCE, SampleBatch

NS_PER_MS = 1e6


@dataclass(frozen=True)
class TimedStream:
    """When each kept sample was taken, and how well that is known.

    Attributes:
        kept: indices of the samples that have a time of their own; repeated ones are left out.
        t_host_ns: their times on the host's clock, strictly increasing.
        report: of the clock fit.
        num_steps: how often the device's clock was stepped.
    """

    kept: Int64[np.ndarray, " n"]
    t_host_ns: Int64[np.ndarray, " n"]
    report: ClockReport
    num_steps: int


def time_stream(
    batch: SampleBatch, descriptor: StreamDescriptor, *, latency_ns: int = 0
) -> TimedStream:
    """Fit the device's clock and date every sample.

    The device's stamps are used where there are any, else its sequence numbers times the nominal
    period, else the arrivals as they are.

    Args:
        batch: the whole take of one stream.
        descriptor: widths and ticks of its counters.
        latency_ns: calibrated constant path delay, taken away from all times.

    Raises:
        ClockFitError: too few samples, or stamps that no clock gives; names the stream.
    """
    device_ns = _device_time(batch, descriptor)
    try:
        model = None if device_ns is None else fit_clock(device_ns, batch.t_host_ns)
    except ClockFitError as error:
        raise ClockFitError(
            f"stream {descriptor.name!r}: {error.message}", stream=descriptor.name, **error.details
        ) from error
    if model is None or device_ns is None:
        t_host_ns = batch.t_host_ns - latency_ns
    else:
        t_host_ns = model.to_host_ns(device_ns, batch.t_host_ns) - latency_ns
    # A sample not later than one before it is a repeat, or lies at the seam of a clock step.
    latest = np.maximum.accumulate(np.concatenate([t_host_ns[:1] - 1, t_host_ns[:-1]]))
    kept = np.flatnonzero(t_host_ns > latest)
    report = ClockReport(
        stream=descriptor.name,
        skew_ppm=None if model is None else model.skew_ppm,
        latency_ms=latency_ns / NS_PER_MS,
        residual_rms_ms=None if model is None else model.residual_rms_ns / NS_PER_MS,
        num_samples=len(kept),
        num_dropped=_num_lost(batch, descriptor) + len(batch) - len(kept),
    )
    return TimedStream(kept, t_host_ns[kept], report, 0 if model is None else model.num_steps)


def _device_time(
    batch: SampleBatch, descriptor: StreamDescriptor
) -> Int64[np.ndarray, " n"] | None:
    capabilities = descriptor.capabilities
    if not (batch.t_device_ns == NO_DEVICE_TIME).any():
        straight = _unwrap(
            batch.t_device_ns, capabilities.device_time_bits, capabilities.tick_ns, batch
        )
        # A stamp is cut down to whole ticks: on average the sample lies half a tick later.
        return straight + capabilities.tick_ns // 2
    if not (batch.sequence == NO_SEQUENCE).any():
        period_ns = descriptor.period_ns()
        numbers = batch.sequence * period_ns
        return _unwrap(numbers, capabilities.sequence_bits, period_ns, batch)
    return None


def _unwrap(
    counts_ns: np.ndarray, bits: int, unit_ns: int, batch: SampleBatch
) -> Int64[np.ndarray, " n"]:
    if bits * np.log(2) + np.log(unit_ns) > 62 * np.log(2):
        return counts_ns.astype(np.int64)
    return unwrap_counter(counts_ns, modulus=2**bits * unit_ns, hint=batch.t_host_ns)


def _num_lost(batch: SampleBatch, descriptor: StreamDescriptor) -> int:
    if (batch.sequence == NO_SEQUENCE).any():
        return 0
    return find_lost_samples(batch.sequence, bits=descriptor.capabilities.sequence_bits).num_missing
