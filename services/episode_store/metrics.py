"""Prometheus metrics of the store: batches, bytes, latencies, refusals, free space."""

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

SECONDS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


class StoreMetrics:
    """Metrics of one store service, exposed by `register`."""

    def __init__(
        self, *, open_uploads: Callable[[], float], free_bytes: Callable[[], float]
    ) -> None:
        self.batches = Counter(
            "dextouch_store_batches",
            "Acknowledged batches; replayed ones were stored before.",
            ("replayed",),
            registry=None,
        )
        self.bytes = Counter(
            "dextouch_store_batch_bytes", "Bytes of acknowledged new batches.", registry=None
        )
        self.ack_seconds = Histogram(
            "dextouch_store_ack_seconds",
            "Time from admission of a batch to its acknowledgement.",
            buckets=SECONDS,
            registry=None,
        )
        self.finish_seconds = Histogram(
            "dextouch_store_finish_seconds",
            "Time from the request to finish an upload to the committed recording.",
            buckets=SECONDS,
            registry=None,
        )
        self.refused = Counter(
            "dextouch_store_refused",
            "Refused upload requests by the exhausted resource.",
            ("reason",),
            registry=None,
        )
        self.open_uploads = Gauge(
            "dextouch_store_open_uploads", "Unfinished uploads.", registry=None
        )
        self.open_uploads.set_function(open_uploads)
        self.free_bytes = Gauge(
            "dextouch_store_free_bytes", "Free bytes on the store's disk.", registry=None
        )
        self.free_bytes.set_function(free_bytes)

    def register(self, registry: CollectorRegistry) -> None:
        """Add all metrics to a registry."""
        for metric in vars(self).values():
            registry.register(metric)
