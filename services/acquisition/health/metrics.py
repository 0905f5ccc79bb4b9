"""Prometheus metrics of the health report, made when someone scrapes."""

from collections.abc import Callable, Iterator, Mapping
from typing import Final

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from dextouch.schemas import StationHealth
from services.acquisition.health.codes import SEVERITY

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


class HealthCollector(Collector):
    """Shows the health report under Prometheus names.

    A stream that is not heard keeps its age, level and counters and loses its figures.

    Args:
        report: gives the report of this moment.
        raised: how often each (stream, code) was raised.
    """

    def __init__(
        self,
        report: Callable[[], StationHealth],
        raised: Callable[[], Mapping[tuple[str, str], int]],
    ) -> None:
        self._report = report
        self._raised = raised
        # A counter must not shrink, as the loss does when an overtaken packet comes.
        self._lost: dict[str, int] = {}

    def collect(self) -> Iterator[Metric]:
        """All metrics of one report."""
        health = self._report()
        yield from _stream_metrics(health)
        yield from self._device_metrics(health)
        for name, text in STATION_FIGURES.items():
            if name in health.figures:
                family = GaugeMetricFamily(f"dextouch_{name}", text)
                family.add_metric((), health.figures[name])
                yield family
        events = CounterMetricFamily(
            "dextouch_health_findings", "Times a finding was raised.", labels=("stream", "code")
        )
        for labels, count in sorted(self._raised().items()):
            events.add_metric(labels, count)
        yield events

    def _device_metrics(self, health: StationHealth) -> Iterator[Metric]:
        connected = GaugeMetricFamily(
            "dextouch_device_connected", "1 while the device is open.", labels=DEVICE_LABELS
        )
        counters = {
            name: CounterMetricFamily(f"dextouch_{name}", text, labels=DEVICE_LABELS)
            for name, (_, text) in DEVICE_COUNTERS.items()
        }
        for device in health.devices:
            labels = (device.hand or "", device.device)
            lost = self._lost[device.device] = max(device.lost, self._lost.get(device.device, 0))
            counts = {**device.model_dump(), "lost": lost}
            connected.add_metric(labels, float(device.connected))
            for name, (field, _) in DEVICE_COUNTERS.items():
                counters[name].add_metric(labels, counts[field])
        yield from (connected, *counters.values())

    def describe(self) -> Iterator[Metric]:
        """Nothing ahead of time: registering asks for no report."""
        return iter(())


def _stream_metrics(health: StationHealth) -> Iterator[Metric]:
    level = GaugeMetricFamily(
        "dextouch_stream_level", "0 OK, 1 WARN, 2 ERROR, 3 STALE.", labels=STREAM_LABELS
    )
    age = GaugeMetricFamily(
        "dextouch_sample_age_seconds", "Since the newest sample.", labels=STREAM_LABELS
    )
    samples = CounterMetricFamily("dextouch_samples", "Samples taken.", labels=STREAM_LABELS)
    figures = {
        name: GaugeMetricFamily(f"dextouch_{name}", text, labels=STREAM_LABELS)
        for name, text in STREAM_FIGURES.items()
    }
    for stream in health.streams:
        labels = (stream.stream, stream.hand or "", stream.device)
        level.add_metric(labels, SEVERITY.index(stream.level))
        samples.add_metric(labels, stream.num_samples)
        if stream.age_s is not None:
            age.add_metric(labels, stream.age_s)
        for name, value in stream.figures.items():
            figures[name].add_metric(labels, value)
    yield from (level, age, samples, *figures.values())
