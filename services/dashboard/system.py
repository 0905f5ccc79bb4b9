"""State of all services, disks and queues, asked while somebody looks at the page System."""

import asyncio
import time
from collections import deque
from collections.abc import Mapping
from math import isfinite
from typing import Final, Literal
from urllib.parse import urlsplit

from prometheus_client.parser import text_string_to_metric_families
from pydantic import ValidationError

from dextouch import __version__
from dextouch.errors import DexTouchError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Health, HealthLevel, Readiness
from services.dashboard.feeds import Topic
from services.dashboard.upstream import Upstream

PERIOD_S: Final = 2.0
# Of the filling rate of a disk: between its samples, least and longest time over which it is taken.
DISK_SAMPLE_S: Final = 5.0
DISK_MIN_SPAN_S: Final = 30.0
DISK_SPAN_S: Final = 3600.0
LOW_BYTES: Final = 10e9
LOW_LEFT_S: Final = 86_400.0
STORE_FREE: Final = "dextouch_store_free_bytes"
SPOOL_FREE: Final = "dextouch_disk_free_bytes"
SPOOL_LEFT: Final = "dextouch_disk_left_seconds"
SPOOL_BYTES: Final = "dextouch_spool_bytes"
SPOOL_KEEP_S: Final = "dextouch_spool_keep_seconds"
SPOOL_KEEP_BYTES: Final = "dextouch_spool_keep_bytes"
UPLOADS: Final = "dextouch_upload_takes"
ALIGNMENTS: Final = "dextouch_alignment_jobs"
ALIGNMENTS_LIMIT: Final = "dextouch_alignment_open_jobs_limit"
CHUNKS: Final = "dextouch_rollout_queue_chunks"
CHUNKS_LIMIT: Final = "dextouch_rollout_queue_limit_chunks"
SHOWN_METRICS: Final = (
    "process_",
    *(STORE_FREE, SPOOL_FREE, SPOOL_LEFT, UPLOADS),
    *(SPOOL_BYTES, SPOOL_KEEP_S, SPOOL_KEEP_BYTES),
    *(ALIGNMENTS, ALIGNMENTS_LIMIT, CHUNKS, CHUNKS_LIMIT),
)
# Samples by their name: value by label values, separated by commas.
Metrics = Mapping[str, Mapping[str, float]]


class ServiceStatus(FrozenModel):
    """A service at its last probe; what it did not say is None.

    `latency_s` is the time of the request for its liveness, `cpu_ratio` of one processor since the
    probe before. Services that share a process have its figures.
    """

    name: str
    address: str
    state: Literal["ready", "waiting", "down"]
    waiting_for: tuple[str, ...] = ()
    problem: str = ""
    service: str | None = None
    version: str | None = None
    uptime_s: float | None = None
    latency_s: float | None = None
    memory_bytes: float | None = None
    cpu_ratio: float | None = None
    shares_process: bool = False


class DiskStatus(FrozenModel):
    """Free space of a disk.

    `fill_bytes_per_s` is its change over the last `span_s`; negative while space becomes free.
    """

    name: str
    level: HealthLevel
    free_bytes: float
    fill_bytes_per_s: float | None
    span_s: float
    left_s: float | None


class SpoolStatus(FrozenModel):
    """Takes in a station's spool, and how long those stay that the store has acknowledged.

    `waiting` includes takes that the store refused; `keep_bytes` is None without such a limit.
    """

    name: str
    waiting_bytes: float
    num_waiting: int
    uploaded_bytes: float
    num_uploaded: int
    keep_s: float
    keep_bytes: float | None


class QueueStatus(FrozenModel):
    """What waits at a service, and how many may wait; None without a limit."""

    name: str
    place: str
    level: HealthLevel
    count: int
    limit: int | None = None


class SystemView(FrozenModel):
    """State of the system; `version` is the dashboard's own."""

    version: str
    services: tuple[ServiceStatus, ...]
    disks: tuple[DiskStatus, ...]
    spools: tuple[SpoolStatus, ...]
    queues: tuple[QueueStatus, ...]


class System:
    """Asks every service for its health and metrics."""

    def __init__(self, stations: Mapping[str, Upstream], upstreams: Mapping[str, Upstream]) -> None:
        others = {name: one for name, one in upstreams.items() if name != "acquisition"}
        self._probes = (
            *(Probe(f"station {name}", one) for name, one in stations.items()),
            *(Probe(name.replace("_", " "), one) for name, one in others.items()),
        )
        self.topic = Topic.of_json("system", PERIOD_S, self.read)

    async def read(self) -> SystemView:
        """The state now; a service that does not answer is part of it."""
        found = await asyncio.gather(*(probe.read() for probe in self._probes))
        services = [service for service, _ in found]
        places = [_process(service, metrics) for service, metrics in found]
        shared = {one for one in places if one is not None and places.count(one) > 1}
        known = [(probe, metrics) for probe, (_, metrics) in zip(self._probes, found, strict=True)]
        return SystemView(
            version=__version__,
            services=tuple(
                service.model_copy(update={"shares_process": place in shared})
                for service, place in zip(services, places, strict=True)
            ),
            disks=tuple(one for probe, metrics in known for one in probe.disks(metrics)),
            spools=tuple(one for probe, metrics in known for one in spools_of(probe.name, metrics)),
            queues=tuple(one for probe, metrics in known for one in queues_of(probe.name, metrics)),
        )


class Probe:
    """Asks one service again and again, and remembers what rates need."""

    def __init__(self, name: str, upstream: Upstream) -> None:
        self.name = name
        self._upstream = upstream
        self._cpu: tuple[float, float] | None = None
        self._free: dict[str, FreeSpace] = {}

    async def read(self) -> tuple[ServiceStatus, Metrics]:
        """The service's state, and its metrics where it has them."""
        address = self._upstream.address
        began_s = time.perf_counter()
        try:
            health = await self._upstream.read(Health, "/healthz")
            latency_s = time.perf_counter() - began_s
            readiness = await self._upstream.answer("/readyz")
            waiting = Readiness.model_validate_json(readiness.content, extra="ignore").waiting_for
        except DexTouchError as error:
            self._cpu = None
            down = ServiceStatus(
                name=self.name, address=address, state="down", problem=error.message
            )
            return down, {}
        except ValidationError:
            waiting = (f"unexpected response to /readyz ({readiness.status_code})",)
        metrics = await self._metrics()
        start_s = _value(metrics, "process_start_time_seconds")
        status = ServiceStatus(
            name=self.name,
            address=address,
            state="waiting" if waiting else "ready",
            waiting_for=waiting,
            service=health.service,
            version=health.version,
            uptime_s=None if start_s is None else max(0.0, time.time() - start_s),
            latency_s=latency_s,
            memory_bytes=_value(metrics, "process_resident_memory_bytes"),
            cpu_ratio=self._cpu_ratio(_value(metrics, "process_cpu_seconds_total")),
        )
        return status, metrics

    async def _metrics(self) -> Metrics:
        try:
            return shown_metrics((await self._upstream.send("GET", "/metrics")).text)
        except (DexTouchError, ValueError):
            return {}  # optional, and its state is known

    def _cpu_ratio(self, cpu_s: float | None) -> float | None:
        before, now_s = self._cpu, time.monotonic()
        self._cpu = None if cpu_s is None else (now_s, cpu_s)
        if before is None or cpu_s is None or cpu_s < before[1] or now_s <= before[0]:
            return None
        return (cpu_s - before[1]) / (now_s - before[0])

    def disks(self, metrics: Metrics) -> list[DiskStatus]:
        """Disks that the service measures."""
        named = ((STORE_FREE, f"{self.name}"), (SPOOL_FREE, f"spool of {self.name}"))
        found = []
        for metric, name in named:
            free_bytes = _value(metrics, metric)
            if free_bytes is not None:
                space = self._free.setdefault(metric, FreeSpace())
                space.add(time.monotonic(), free_bytes)
                left_s = _value(metrics, SPOOL_LEFT) if metric == SPOOL_FREE else None
                found.append(space.status(name, left_s))
        return found


class FreeSpace:
    """Free bytes of a disk over the last hour."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque()

    def add(self, now_s: float, free_bytes: float) -> None:
        """Note a sample; those that follow the one before too soon replace it."""
        samples = self._samples
        if len(samples) > 1 and now_s - samples[-2][0] < DISK_SAMPLE_S:
            samples.pop()
        samples.append((now_s, free_bytes))
        while now_s - samples[0][0] > DISK_SPAN_S:
            samples.popleft()

    def status(self, name: str, known_left_s: float | None) -> DiskStatus:
        """State of the disk; `known_left_s` is the service's own estimate."""
        (first_s, first_bytes), (last_s, free_bytes) = self._samples[0], self._samples[-1]
        span_s = last_s - first_s
        rate = (first_bytes - free_bytes) / span_s if span_s >= DISK_MIN_SPAN_S else None
        left_s = free_bytes / rate if rate is not None and rate > 0 else known_left_s
        low = free_bytes < LOW_BYTES or (left_s is not None and left_s < LOW_LEFT_S)
        return DiskStatus(
            name=name,
            level="WARN" if low else "OK",
            free_bytes=free_bytes,
            fill_bytes_per_s=rate,
            span_s=span_s,
            left_s=left_s,
        )


def shown_metrics(text: str) -> Metrics:
    """Samples that the page shows, of a text in Prometheus format.

    Raises:
        ValueError: the text is of another format.
    """
    # Parsing all of a station's metrics would take longer than a taxel map has.
    lines = "".join(f"{line}\n" for line in text.splitlines() if line.startswith(SHOWN_METRICS))
    found: dict[str, dict[str, float]] = {}
    try:
        families = list(text_string_to_metric_families(lines))
    except IndexError as error:
        raise ValueError(f"metrics: expected the Prometheus text format ({error})") from error
    for sample in (sample for family in families for sample in family.samples):
        if isfinite(sample.value):
            found.setdefault(sample.name, {})[", ".join(sample.labels.values())] = sample.value
    return found


def spools_of(name: str, metrics: Metrics) -> list[SpoolStatus]:
    """The spool of a station by its metrics; none of other services."""
    keep_s = _value(metrics, SPOOL_KEEP_S)
    if keep_s is None:
        return []
    sizes, counts = metrics.get(SPOOL_BYTES, {}), metrics.get(UPLOADS, {})
    return [
        SpoolStatus(
            name=name,
            waiting_bytes=sizes.get("waiting", 0.0) + sizes.get("refused", 0.0),
            num_waiting=int(counts.get("waiting", 0) + counts.get("refused", 0)),
            uploaded_bytes=sizes.get("uploaded", 0.0),
            num_uploaded=int(counts.get("uploaded", 0)),
            keep_s=keep_s,
            keep_bytes=_value(metrics, SPOOL_KEEP_BYTES),
        )
    ]


def queues_of(place: str, metrics: Metrics) -> list[QueueStatus]:
    """Queues of a service by its metrics."""
    jobs, limit = metrics.get(ALIGNMENTS, {}), _value(metrics, ALIGNMENTS_LIMIT)
    room = None if limit is None else limit - jobs.get("running", 0)
    rows: list[tuple[str, float | None, float | None, bool]] = []
    for state, count in metrics.get(UPLOADS, {}).items():
        rows.append((f"uploads {state}", count, None, state == "refused"))
    for state, count in jobs.items():
        if state in {"waiting", "running", "failed"}:
            most = room if state == "waiting" else None
            rows.append((f"alignments {state}", count, most, state == "failed"))
    for world, count in metrics.get(CHUNKS, {}).items():
        most = metrics.get(CHUNKS_LIMIT, {}).get(world)
        rows.append((f"chunks waiting for {world}", count, most, False))
    return [
        QueueStatus(
            name=name,
            place=place,
            level="WARN" if count and (is_bad or (most is not None and count >= most)) else "OK",
            count=int(count or 0),
            limit=None if most is None else int(most),
        )
        for name, count, most, is_bad in rows
        if name != "uploads uploaded"
    ]


def _value(metrics: Metrics, name: str) -> float | None:
    """Value of a metric without labels."""
    return metrics.get(name, {}).get("")


def _process(service: ServiceStatus, metrics: Metrics) -> tuple[str | None, float] | None:
    """By which services of one process are recognised."""
    start_s = _value(metrics, "process_start_time_seconds")
    return None if start_s is None else (urlsplit(service.address).hostname, start_s)
