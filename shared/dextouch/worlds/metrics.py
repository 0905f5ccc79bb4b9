"""Prometheus metrics of the worlds of a process: queues, rollouts and sizes of batches."""

from collections.abc import Iterator

from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from dextouch.worlds.rollouts import RolloutService


class WorldMetrics(Collector):
    """Shows a process's rollouts."""

    def __init__(self, service: RolloutService) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """All metrics of this moment."""
        queues = self._service.queues()
        text = "Chunks that wait for their world."
        waiting = GaugeMetricFamily("dextouch_rollout_queue_chunks", text, labels=("world",))
        text = "Chunks that may wait; more are refused."
        limit = GaugeMetricFamily("dextouch_rollout_queue_limit_chunks", text, labels=("world",))
        for world, (num_waiting, max_waiting) in queues.items():
            waiting.add_metric((world,), num_waiting)
            limit.add_metric((world,), max_waiting)
        yield from (waiting, limit)
        text = "Rollouts whose state this process holds."
        yield GaugeMetricFamily("dextouch_live_rollouts", text, self._service.num_live)
        text = "Rollouts that all processes together may hold; further starts are refused."
        most = self._service.limits.max_rollouts
        yield GaugeMetricFamily("dextouch_rollouts_limit", text, most)
        text = "1 while the process refuses new rollouts because it is about to end."
        yield GaugeMetricFamily("dextouch_draining", text, float(self._service.is_draining))
        yield from self._service.batches.collect()
