"""Prometheus metrics of a station's recorder and uploads."""

from collections.abc import Callable, Iterator, Mapping
from typing import get_args

from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from dextouch.schemas import RecorderState, RecorderStatus


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
