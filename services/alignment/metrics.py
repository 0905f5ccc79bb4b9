"""Prometheus metrics of the alignment queue."""

from collections import Counter as Counts
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Final, get_args

from prometheus_client import Counter, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from services.alignment.job_queue import JobQueue
from services.alignment.schemas import AlignmentJob, JobState

SECONDS: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)


class AlignmentMetrics(Collector):
    """Shows the queue, and counts the alignments that ended since the start.

    Args:
        queue: of the service's jobs.
    """

    def __init__(self, queue: JobQueue) -> None:
        self._queue = queue
        self._ended = Counter(
            "dextouch_alignments_ended", "Alignments that ended.", ("state",), registry=None
        )
        self._seconds = Histogram(
            "dextouch_alignment_seconds",
            "Duration of the last attempt of an alignment that is done.",
            buckets=SECONDS,
            registry=None,
        )
        for state in ("done", "failed", "cancelled"):
            self._ended.labels(state)

    def count(self, job: AlignmentJob) -> None:
        """Count a job that has just ended."""
        self._ended.labels(job.state).inc()
        if job.state == "done" and job.started_at is not None and job.ended_at is not None:
            self._seconds.observe((job.ended_at - job.started_at).total_seconds())

    def collect(self) -> Iterator[Metric]:
        """All metrics of this moment."""
        jobs = self._queue.jobs()
        states = Counts(job.state for job in jobs)
        text = "Alignments that the service remembers, by state."
        shown = GaugeMetricFamily("dextouch_alignment_jobs", text, labels=("state",))
        for state in get_args(JobState):
            shown.add_metric((state,), states[state])
        yield shown
        text = "Alignments that may wait or run; more are refused."
        yield GaugeMetricFamily("dextouch_alignment_open_jobs_limit", text, self._queue.max_open)
        now = datetime.now(UTC)
        waits = (job.submitted_at for job in jobs if job.state == "waiting")
        ages_s = [(now - since).total_seconds() for since in waits if since is not None]
        text = "For how long the oldest waiting alignment has waited; 0 without one."
        oldest_s = max(ages_s, default=0.0)
        yield GaugeMetricFamily("dextouch_alignment_oldest_waiting_seconds", text, oldest_s)
        yield from self._ended.collect()
        yield from self._seconds.collect()
