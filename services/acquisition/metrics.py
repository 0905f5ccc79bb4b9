"""Prometheus metrics of a station's recorder, uploads and spool."""

from collections.abc import Callable, Iterator, Mapping
from typing import get_args

from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from dextouch.schemas import RecorderState, RecorderStatus
from services.acquisition.retention import DAY_S, GIGABYTE, SpoolRetention


class RecorderCollector(Collector):
    """Shows the recorder's state, and takes of the spool by what became of their upload.

    Args:
        status: of the recorder.
        takes: number of saved takes by state of their upload.
    """

    def __init__(
        self, status: Callable[[], RecorderStatus], takes: Callable[[], Mapping[str, int]]
    ) -> None:
        self._status, self._takes = status, takes

    def collect(self) -> Iterator[Metric]:
        """All metrics of this moment."""
        status = self._status()
        text = "1 for the recorder's state, 0 for the others."
        states = GaugeMetricFamily("dextouch_recorder_state", text, labels=("state",))
        for state in get_args(RecorderState):
            states.add_metric((state,), float(state == status.state))
        yield states
        text = "Length of the current take; 0 without one."
        yield GaugeMetricFamily("dextouch_take_seconds", text, status.duration_s or 0.0)
        text = "Takes in the spool: waiting to be uploaded, uploaded, or refused by the store."
        takes = GaugeMetricFamily("dextouch_upload_takes", text, labels=("state",))
        for upload, number in self._takes().items():
            takes.add_metric((upload,), number)
        yield takes


class SpoolCollector(Collector):
    """Shows how much of the disk takes occupy, and how long acknowledged ones stay.

    Args:
        retention: of the spool.
    """

    def __init__(self, retention: SpoolRetention) -> None:
        self._retention = retention

    def collect(self) -> Iterator[Metric]:
        """All metrics of this moment."""
        text = "Bytes of takes in the spool by what became of their upload."
        sizes = GaugeMetricFamily("dextouch_spool_bytes", text, labels=("state",))
        for state, num_bytes in self._retention.use().items():
            sizes.add_metric((state,), num_bytes)
        yield sizes
        limits = self._retention.limits
        text = "How long takes stay in the spool after the store acknowledged them."
        yield GaugeMetricFamily(
            "dextouch_spool_keep_seconds", text, limits.keep_uploaded_days * DAY_S
        )
        if limits.keep_uploaded_gb is not None:
            text = "Bytes of acknowledged takes that stay in the spool at most."
            yield GaugeMetricFamily(
                "dextouch_spool_keep_bytes", text, limits.keep_uploaded_gb * GIGABYTE
            )
