"""Prometheus metrics of a station's health, recorder, uploads and spool, made at each scrape."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from dextouch.schemas import RecorderState, RecorderStatus, StationHealth
from services.acquisition.health.codes import SEVERITY
from services.acquisition.retention import DAY_S, GIGABYTE, SpoolRetention

STREAM_LABELS = ("stream", "hand", "device")
DEVICE_LABELS = ("hand", "device")
STREAM_FIGURES: Final = {
    "rate_hz": "Samples a second over 10 s.",
    "drop_ratio": "Packets lost by sequence over 10 s.",
    "damaged_ratio": "Packets with a wrong checksum or length over 10 s.",
    "refused_ratio": "Packets that hold no sample over 10 s.",
    "suspect_ratio": "Packets held back as suspect over 10 s.",
    "interarrival_p99_seconds": "99 % of samples come sooner than this after the one before.",
    "host_latency_p99_seconds": "99 % of samples are spooled sooner than this after the read.",
    "clock_offset_seconds": "Time of the host minus that of the device, since its first sample.",
    "clock_skew_ratio": "How much faster the host's clock runs than the device's.",
    "clock_residual_p95_seconds": "95 % of arrivals lie closer to the fitted clock's median.",
    "clock_sigma_seconds": "Scatter of the fitted clock's offset.",
    "path_latency_seconds": "Path delay of the samples, by the answers of the device.",
    "path_latency_sigma_seconds": "Standard deviation of the path delay.",
    "time_requests_failed": "Time requests that the device did not answer since the start.",
    "clock_resets": "Steps and restarts of the device's clock since the start.",
    "dead_taxels_ratio": "Taxels that read nothing.",
    "stuck_taxels_ratio": "Taxels that stay at one load while their neighbours move.",
    "saturated_taxels_ratio": "Taxels at full scale for longer than a second.",
    "baseline_drift_ratio": "Zero shift since the tare, in standard deviations of the tare.",
    "missing_ratio": "Values that are no numbers over 10 s.",
    "tracking_lost_ratio": "Poses outside the running state over 10 s.",
    "stationary_jitter_meters": "RMS of a resting body's position.",
    "image_clipped_ratio": "Pixels at the limit.",
    "image_frozen": "1 while the same image comes again and again.",
    "image_blurred": "1 while images are much less sharp than usual.",
}
STATION_FIGURES: Final = {
    "disk_free_bytes": "Free bytes on the disk of the takes.",
    "disk_left_seconds": "How long that disk lasts at the present rate.",
    "calibration_age_seconds": "Age of the oldest calibration that says when it was made.",
    "latency_sigma_seconds": "Largest stated uncertainty of a path delay.",
    "host_cpu_ratio": "Share of the processors' time that was used.",
    "host_cpu_10s_ratio": "The same over 10 s.",
    "host_wake_p90_seconds": "90 % of the wakes of a thread of the station are less late.",
    "unjudged_samples": "Samples that the health evaluation did not see.",
}
# The field of the device's health that each counter shows.
DEVICE_COUNTERS: Final = {
    "packets": ("packets", "Packets decoded."),
    "lost_packets": ("lost", "Packets lost by sequence."),
    "crc_errors": ("crc_errors", "Wrong checksums."),
    "length_errors": ("length_errors", "Impossible lengths."),
    "resync_bytes": ("resync_bytes", "Bytes skipped in search of a packet."),
    "refused_packets": ("refused", "Packets that hold no sample."),
    "suspect_packets": ("suspects", "Packets held back as suspect."),
    "repeated_packets": ("repeated", "Packets that came twice."),
    "restarts": ("restarts", "Steps back of the sequence."),
    "queue_dropped": ("queue_dropped", "What fell out of a driver's queue."),
    "reconnects": ("reconnects", "Times the device was lost after it was open."),
    "reader_failures": ("failures", "Unexpected errors in the reader."),
}
LEVELS = "0 OK, 1 WARN, 2 ERROR, 3 STALE."
Rows = Sequence[tuple[Sequence[str], float | int]]


@dataclass(eq=False)
class HealthCollector(Collector):
    """Shows the health report under Prometheus names.

    A stream that is not heard keeps its age, level and counters and loses its figures.
    """

    report: Callable[[], StationHealth]
    raised: Callable[[], Mapping[tuple[str, str], int]]
    # A counter must not shrink, as the loss does when an overtaken packet comes.
    _lost: dict[str, int] = field(default_factory=dict)

    def collect(self) -> Iterator[Metric]:
        """All metrics of one report."""
        health = self.report()
        streams = [((s.stream, s.hand or "", s.device), s) for s in health.streams]
        devices = [((d.hand or "", d.device), d.model_dump()) for d in health.devices]
        for (_, name), counts in devices:
            counts["lost"] = self._lost[name] = max(counts["lost"], self._lost.get(name, 0))
        gauge, counter = GaugeMetricFamily, CounterMetricFamily
        rows: Rows = [(labels, SEVERITY.index(s.level)) for labels, s in streams]
        yield _filled(gauge("dextouch_stream_level", LEVELS, labels=STREAM_LABELS), rows)
        rows = [(labels, s.age_s) for labels, s in streams if s.age_s is not None]
        text = "Since the newest sample."
        yield _filled(gauge("dextouch_sample_age_seconds", text, labels=STREAM_LABELS), rows)
        rows = [(labels, s.num_samples) for labels, s in streams]
        yield _filled(counter("dextouch_samples", "Samples taken.", labels=STREAM_LABELS), rows)
        for name, text in STREAM_FIGURES.items():
            rows = [(labels, s.figures[name]) for labels, s in streams if name in s.figures]
            yield _filled(gauge(f"dextouch_{name}", text, labels=STREAM_LABELS), rows)
        rows = [(labels, float(counts["connected"])) for labels, counts in devices]
        text = "1 while the device is open."
        yield _filled(gauge("dextouch_device_connected", text, labels=DEVICE_LABELS), rows)
        for name, (event, text) in DEVICE_COUNTERS.items():
            rows = [(labels, counts[event]) for labels, counts in devices]
            yield _filled(counter(f"dextouch_{name}", text, labels=DEVICE_LABELS), rows)
        for name, text in STATION_FIGURES.items():
            if name in health.figures:
                yield gauge(f"dextouch_{name}", text, value=health.figures[name])
        text, labels = "Times a finding was raised.", ("stream", "code")
        events = counter("dextouch_health_findings", text, labels=labels)
        yield _filled(events, sorted(self.raised().items()))

    def describe(self) -> Iterator[Metric]:
        """Nothing ahead of time: registering asks for no report."""
        return iter(())


@dataclass(eq=False)
class RecorderCollector(Collector):
    """Shows the recorder's state, uploads of takes, and how much of the disk takes occupy."""

    status: Callable[[], RecorderStatus]
    takes: Callable[[], Mapping[str, int]]
    retention: SpoolRetention

    def collect(self) -> Iterator[Metric]:
        """All metrics of this moment."""
        status, labels, gauge = self.status(), ("state",), GaugeMetricFamily
        text = "1 for the recorder's state, 0 for the others."
        rows: Rows = [((s,), float(s == status.state)) for s in get_args(RecorderState)]
        yield _filled(gauge("dextouch_recorder_state", text, labels=labels), rows)
        text = "Length of the current take; 0 without one."
        yield gauge("dextouch_take_seconds", text, status.duration_s or 0.0)
        text = "Takes in the spool: waiting to be uploaded, uploaded, or refused by the store."
        rows = [((state,), number) for state, number in self.takes().items()]
        yield _filled(gauge("dextouch_upload_takes", text, labels=labels), rows)
        text = "Bytes of takes in the spool by what became of their upload."
        rows = [((state,), num_bytes) for state, num_bytes in self.retention.use().items()]
        yield _filled(gauge("dextouch_spool_bytes", text, labels=labels), rows)
        limits = self.retention.limits
        text = "How long takes stay in the spool after the store acknowledged them."
        yield gauge("dextouch_spool_keep_seconds", text, limits.keep_uploaded_days * DAY_S)
        if limits.keep_uploaded_gb is not None:
            text = "Bytes of acknowledged takes that stay in the spool at most."
            yield gauge("dextouch_spool_keep_bytes", text, limits.keep_uploaded_gb * GIGABYTE)


def _filled(
    family: GaugeMetricFamily | CounterMetricFamily, rows: Rows
) -> GaugeMetricFamily | CounterMetricFamily:
    for labels, value in rows:
        family.add_metric(labels, value)
    return family
