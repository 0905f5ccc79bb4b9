"""Online clock that estimates host times of samples as they arrive: causal and monotonic."""

from typing import Literal

from dextouch.clocks.counters import nearest_congruent, prefers_sequence
from dextouch.clocks.running_envelope import MIN_SLOPE_SPAN_S, RunningEnvelope
from dextouch.errors import InvalidInputError
from dextouch.streams import StreamDescriptor

ABSENT = -1

# A nominal rate can be off by percents, a crystal by tens of ppm: counted samples need a slope
# earlier than stamped ones.
COUNTED_SLOPE_SPAN_S = 0.5

Source = Literal["device", "sequence", "arrival"]


class OnlineClock:
    """Running estimate of the time at which each sample left its device, on the host's clock.

    The line under the (device time, apparent offset) points of the last minute, as in `fit_clock`,
    but causal (`RunningEnvelope`). Without device time, or where it is very coarse, the sequence
    number times the nominal period is the device's clock; without either, the arrival itself is
    returned (`CountingClock` is more accurate for such samples, with a delay).

    Args:
        descriptor: the stream's descriptor; needed for wrapping or coarse stamps and for streams
            that have only a sequence number.
    """

    def __init__(self, descriptor: StreamDescriptor | None = None) -> None:
        self._counter = DeviceCounter(descriptor)
        self._envelope = RunningEnvelope()
        self._last_ns: int | None = None
        # Device time of the first sample, and its arrival minus that.
        self._start: tuple[int, int] | None = None

    @property
    def source(self) -> Source | None:
        """Source of the clock: device, sequence or arrival; None before the first sample."""
        return self._counter.source

    @property
    def num_steps(self) -> int:
        """Steps and restarts of the device's clock found so far."""
        return self._envelope.num_steps

    @property
    def skew_ppm(self) -> float:
        """How much faster the host's clock runs than the device's, present estimate."""
        return self._envelope.slope_ns_per_s * 1e-3

    @property
    def spread_ns(self) -> float:
        """Recent mean of the path delay above its minimum."""
        return self._envelope.spread_ns

    def update(
        self, *, t_host_ns: int, t_device_ns: int | None = None, sequence: int | None = None
    ) -> int:
        """Corrected host time of one sample, strictly increasing.

        Args:
            t_host_ns: arrival on the host's monotonic clock.
            t_device_ns: the device's raw stamp (wrapping as in the descriptor); None or -1 if the
                device has none.
            sequence: the device's sequence number; None or -1 likewise.

        Raises:
            InvalidInputError: a stamp or number that earlier samples had is missing.
        """
        device_ns = self._counter.straighten(t_host_ns, t_device_ns, sequence)
        estimate_ns = t_host_ns if device_ns is None else self._estimate(device_ns, t_host_ns)
        if self._last_ns is not None and estimate_ns <= self._last_ns:
            estimate_ns = self._last_ns + 1
        self._last_ns = estimate_ns
        return estimate_ns

    def _estimate(self, device_ns: int, t_host_ns: int) -> int:
        if self._start is None:
            self._start = device_ns, t_host_ns - device_ns
            counted = self._counter.source == "sequence"
            self._envelope = RunningEnvelope(
                resolution_ns=self._counter.resolution_ns,
                min_slope_span_s=COUNTED_SLOPE_SPAN_S if counted else MIN_SLOPE_SPAN_S,
                is_counted=counted,
            )
        start_ns, reference_ns = self._start
        since_ns, ahead_ns = device_ns - start_ns, t_host_ns - device_ns - reference_ns
        now_s = (since_ns + ahead_ns) * 1e-9
        offset_ns = self._envelope.add(since_ns * 1e-9, float(ahead_ns), now_s)
        # Stamps are truncated to whole ticks: on average the sample is half a tick later. The line
        # does not show it, since it is determined by the stamps with the smallest truncation.
        return device_ns + reference_ns + round(offset_ns) + self._counter.resolution_ns // 2


class DeviceCounter:
    """Continuous device time from stamps, or else from sequence numbers times the period.

    The first sample decides: stamps if present, unless they are coarser than a quarter of the
    period and samples are numbered. Device time is truncated to multiples of `resolution_ns`.
    """

    def __init__(self, descriptor: StreamDescriptor | None) -> None:
        self._descriptor = descriptor
        self._period_ns = 0 if descriptor is None else descriptor.period_ns()
        self.resolution_ns = 0
        self._modulus_ns: int | None = None
        self._last: tuple[int, int] | None = None
        self.source: Source | None = None

    def straighten(
        self, t_host_ns: int, t_device_ns: int | None, sequence: int | None
    ) -> int | None:
        """Device time of one sample, in ns; None if the device provides no counter."""
        t_device_ns = None if t_device_ns == ABSENT else t_device_ns
        sequence = None if sequence == ABSENT else sequence
        if self.source is None:
            self._choose(has_time=t_device_ns is not None, has_sequence=sequence is not None)
        if self.source == "arrival":
            return None
        count_ns = t_device_ns
        if self.source == "sequence":
            count_ns = None if sequence is None else sequence * self._period_ns
        if count_ns is None:
            raise InvalidInputError(
                f"online clock: a sample at {t_host_ns} ns came without its {self.source} stamp, "
                "which earlier samples had; expected the same fields in every sample of a stream"
            )
        if self._modulus_ns is not None and self._last is not None:
            expected_ns = self._last[0] + t_host_ns - self._last[1]
            count_ns = nearest_congruent(count_ns, expected_ns, self._modulus_ns)
        self._last = (count_ns, t_host_ns)
        return count_ns

    def _choose(self, *, has_time: bool, has_sequence: bool) -> None:
        if self._descriptor is None:
            self.source = "device" if has_time else "arrival"
            return
        device = self._descriptor.capabilities
        if has_time and not (has_sequence and prefers_sequence(device.tick_ns, self._period_ns)):
            self.source = "device"
            self.resolution_ns = device.tick_ns
            bits, unit_ns = device.device_time_bits, device.tick_ns
        elif has_sequence:
            self.source = "sequence"
            bits, unit_ns = device.sequence_bits, self._period_ns
        else:
            self.source = "arrival"
            return
        # A wider counter never wraps.
        self._modulus_ns = 2**bits * unit_ns if bits <= 62 else None
