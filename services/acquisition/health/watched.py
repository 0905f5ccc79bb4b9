"""What the health monitor watches: the station and its streams, with their state in the report."""

import numpy as np

from dextouch.schemas import DeviceHealth, StaleCode, StreamHealth
from dextouch.streams import StreamDescriptor
from services.acquisition.health.codes import CODES
from services.acquisition.health.levels import Board, Judge, Verdict, raised_finding, worst
from services.acquisition.health.samples import Block, SampleQueue
from services.acquisition.supervisor import DeviceSupervisor

STALE_AFTER_NS = {"image": 500_000_000}
STALE_AFTER_OTHERS_NS = 200_000_000
LATE_PERIODS = round(CODES["late"].warn)
_NO_NUMBERS = np.empty(0, dtype=np.int64)
_NO_SAMPLES = Block(_NO_NUMBERS, _NO_NUMBERS, _NO_NUMBERS, _NO_NUMBERS)


class Watched:
    """The station or one of its streams, with its checks and their latest results."""

    def __init__(self, name: str, judges: list[Judge]) -> None:
        self.name = name
        self.judges = judges
        self.board = Board()
        self.figures: dict[str, float] = {}
        self.evaluated_ns = 0
        self.is_suspicious = False

    def verdicts(self, now_ns: int) -> list[Verdict]:
        """What the checks say now."""
        block = self.take()
        return [judge(block, now_ns) for judge in self.judges]

    def take(self) -> Block:
        """Samples since the last evaluation; none of the station itself."""
        return _NO_SAMPLES


class WatchedStream(Watched):
    """One stream of a device, and its samples that wait for the next evaluation.

    A silent stream is detected for every report; it has no figures.
    """

    def __init__(
        self, supervisor: DeviceSupervisor, descriptor: StreamDescriptor, judges: list[Judge]
    ) -> None:
        super().__init__(descriptor.name, judges)
        self.supervisor = supervisor
        self.descriptor = descriptor
        self.counters = supervisor.streams[descriptor.name]
        self.queue = SampleQueue(descriptor)
        # As the event log knows it.
        self.stale: StaleCode | None = None

    def take(self) -> Block:
        """Samples since the last evaluation."""
        return self.queue.take()

    def stale_code(self, now_ns: int) -> StaleCode | None:
        """Why the stream is stale, None when it is not.

        "unplugged" when the device is not open, "silent" when it is and nothing comes; a slow
        stream may take 3 of its periods at least.
        """
        if not self.supervisor.connected.is_set():
            return "unplugged"
        limit_ns = STALE_AFTER_NS.get(self.descriptor.kind, STALE_AFTER_OTHERS_NS)
        limit_ns = max(limit_ns, LATE_PERIODS * self.descriptor.period_ns())
        last_ns = self.counters.last_t_host_ns
        return "silent" if last_ns is None or now_ns - last_ns > limit_ns else None

    def health(self, now_ns: int) -> StreamHealth:
        """The stream at this moment."""
        descriptor, statistics = self.descriptor, self.supervisor.driver.statistics
        findings, figures = self.board.active(now_ns), self.figures
        age_ns = None
        if self.counters.last_t_host_ns is not None:
            age_ns = max(0, now_ns - self.counters.last_t_host_ns)
        stale = self.stale_code(now_ns)
        if stale is not None:
            text = self._stale_words(stale, age_ns)
            is_stale = raised_finding(stale, "STALE", text, lasted_ns=age_ns)
            findings, figures = (is_stale, *findings), {}
        elif not findings and age_ns is not None and age_ns > LATE_PERIODS * descriptor.period_ns():
            findings = (raised_finding("late", "WARN", "late", lasted_ns=age_ns),)
        skew = figures.get("clock_skew_ratio")
        residual_s = figures.get("clock_residual_p95_seconds")
        return StreamHealth(
            stream=self.name,
            device=self.supervisor.driver.name,
            hand=descriptor.side,
            level=worst([finding.level for finding in findings]),
            stale=stale,
            reasons=tuple(finding.message for finding in findings),
            findings=findings,
            figures=figures,
            rate_hz=figures.get("rate_hz"),
            nominal_rate_hz=descriptor.nominal_rate_hz,
            age_s=None if age_ns is None else age_ns / 1e9,
            num_samples=self.counters.num_samples,
            received=statistics.packets,
            lost=statistics.lost,
            skew_ppm=None if skew is None else skew * 1e6,
            clock_residual_ms=None if residual_s is None else residual_s * 1e3,
        )

    def _stale_words(self, stale: StaleCode, age_ns: int | None) -> str:
        if self.supervisor.last_error is not None:
            return self.supervisor.last_error
        if stale == "unplugged":
            return "not connected"
        return "no data yet" if age_ns is None else f"no data for {age_ns * 1e-9:.1f} s"


def device_health(supervisor: DeviceSupervisor) -> DeviceHealth:
    """A device's counters."""
    driver, events = supervisor.driver, supervisor.events()
    sides = {descriptor.side for descriptor in driver.descriptors}
    return DeviceHealth.model_validate(
        {
            **{name: events[name] for name in DeviceHealth.model_fields if name in events},
            "device": driver.name,
            "hand": sides.pop() if len(sides) == 1 else None,
            "connected": supervisor.connected.is_set(),
            "address": str(driver.info),
            "queue_dropped": events.get("queue", 0),
            "reconnects": supervisor.reconnects,
            "failures": events["driver_failure"],
            "last_error": supervisor.last_error,
        }
    )
