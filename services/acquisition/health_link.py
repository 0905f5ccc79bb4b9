"""Health check of a stream's link: its rate, loss, damage, gaps and lateness."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from dextouch.streams import StreamDescriptor
from services.acquisition.drivers.base import Driver
from services.acquisition.health_blocks import Block, Rolling
from services.acquisition.health_camera import ChecksImages
from services.acquisition.health_levels import Verdict, above
from services.acquisition.schemas import Code, HealthFinding
from services.acquisition.supervisor import DeviceSupervisor

WINDOW_NS = 10_000_000_000
RATE_LIMITS = (0.02, 0.10)
LOSS_LIMITS = (0.001, 0.01)
LATE_PERIODS = (2.0, 5.0)
# A pause of a tenth of a second is worth a word, whatever the rate; half a second is not a pause.
GAP_LIMITS_S = (0.1, 0.5)
GAP_PERIODS = 3
MIN_RATE_SPAN_NS = 900_000_000
MIN_ARRIVALS = 20
SILENT_NS = 200_000_000


def queue_dropped(driver: Driver) -> int:
    """Images dropped from the full queue of the driver's encoder since the start."""
    return driver.quality.num_dropped if isinstance(driver, ChecksImages) else 0


@dataclass(frozen=True)
class _Counts:
    """Everything countable about one stream's device at one moment."""

    t_ns: int
    samples: int
    packets: int
    lost: int
    damaged: int
    resync_bytes: int
    skipped_bytes: int
    refused: int
    suspects: int
    repeated: int
    restarts: int
    reconnects: int
    dropped: int
    late: int
    wrong_side: int
    wrong_version: int


class LinkJudge:
    """Checks the last 10 s of one stream on its path from the device to the spool."""

    def __init__(self, supervisor: DeviceSupervisor, descriptor: StreamDescriptor) -> None:
        self._supervisor = supervisor
        self._descriptor = descriptor
        self._is_settled = False
        self._counts: deque[_Counts] = deque()
        self._counts.append(self._count(0))
        self._steps = Rolling(WINDOW_NS)
        self._latencies = Rolling(WINDOW_NS)
        self._last_ns: int | None = None

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        counts = self._counts
        counts.append(self._count(now_ns))
        while len(counts) > 2 and counts[1].t_ns <= now_ns - WINDOW_NS:
            counts.popleft()
        findings, figures = self._judge_counts(counts[0], counts[-1])
        arrivals = self._judge_arrivals(block, now_ns)
        findings += self._judge_stamps(block) + arrivals.findings
        return Verdict(findings, {**figures, **arrivals.figures})

    def _count(self, now_ns: int) -> _Counts:
        statistics, counters = self._supervisor.driver.statistics, self._supervisor.counters
        driver, events = self._supervisor.driver, self._supervisor.events()
        samples = counters.streams[self._descriptor.name].num_samples
        return _Counts(
            t_ns=now_ns,
            samples=samples,
            packets=statistics.packets,
            lost=statistics.lost,
            damaged=statistics.crc_errors + statistics.length_errors,
            resync_bytes=statistics.resync_bytes,
            skipped_bytes=self._skipped_bytes(
                statistics.resync_bytes, samples, counters.reconnects
            ),
            refused=statistics.refused,
            suspects=statistics.suspects,
            # The guard of the order sees repetitions that lie further back, and nothing where a
            # device has no clock; what both see counts once.
            repeated=max(statistics.repeated, events.get("repeated", 0)),
            restarts=statistics.restarts,
            reconnects=counters.reconnects,
            dropped=queue_dropped(driver),
            late=max(statistics.late, events.get("late", 0)),
            wrong_side=events.get("wrong_side", 0),
            wrong_version=events.get("wrong_version", 0),
        )

    def _skipped_bytes(self, resync_bytes: int, samples: int, reconnects: int) -> int:
        """Bytes skipped so far, without those of the search that each opening begins with."""
        before = self._counts[-1] if self._counts else None
        if before is None:
            return 0
        is_settled = self._is_settled
        if reconnects != before.reconnects:
            self._is_settled = is_settled = False
        elif samples > before.samples:
            self._is_settled = True
        return before.skipped_bytes + (resync_bytes - before.resync_bytes if is_settled else 0)

    def _judge_counts(
        self, first: _Counts, last: _Counts
    ) -> tuple[tuple[HealthFinding, ...], dict[str, float]]:
        expected = round(self._descriptor.nominal_rate_hz * WINDOW_NS * 1e-9)
        packets = max(expected, last.packets - first.packets + last.lost - first.lost)
        # A late packet is no longer counted as lost once it arrives.
        lost = max(0, last.lost - first.lost) / packets
        damaged = last.damaged - first.damaged
        refused = last.refused - first.refused
        suspects = last.suspects - first.suspects
        late = last.late - first.late
        dropped = last.dropped - first.dropped
        resync = last.skipped_bytes - first.skipped_bytes
        findings = (
            *above("loss", lost, LOSS_LIMITS, f"{lost:.1%} of packets lost"),
            *above("damage", damaged / packets, LOSS_LIMITS, f"{damaged} packets damaged"),
            *above(
                "refused", refused / packets, LOSS_LIMITS, f"{refused} packets without a sample"
            ),
            *above("suspect", suspects / packets, LOSS_LIMITS, f"{suspects} packets held back"),
            *above(
                "queue",
                dropped / packets,
                LOSS_LIMITS,
                f"{dropped} images dropped from a full queue",
            ),
            *_events("repeated", last.repeated - first.repeated, "duplicate packets"),
            *_events("reordered", late, "late packets dropped"),
            *_events("restart", last.restarts - first.restarts, "restarts of the device"),
            *self._judge_connection(first, last),
        )
        if resync and not damaged:
            findings += _events("damage", resync, "bytes skipped between packets")
        return findings, {
            "drop_ratio": lost,
            "damaged_ratio": damaged / packets,
            "refused_ratio": refused / packets,
            "suspect_ratio": suspects / packets,
        }

    def _judge_connection(self, first: _Counts, last: _Counts) -> tuple[HealthFinding, ...]:
        reason = self._supervisor.counters.last_error or "the driver rejects its packets"
        reconnects = last.reconnects - first.reconnects
        code: Code
        stream = self._supervisor.counters.streams[self._descriptor.name]
        is_heard = stream.last_t_host_ns is not None and (
            last.t_ns - stream.last_t_host_ns < SILENT_NS
        )
        heard = [count for count in self._counts if count.samples < last.samples]
        before = heard[-1] if heard else first
        if last.wrong_side > first.wrong_side:
            code = "wrong_side"
        elif last.wrong_version > first.wrong_version:
            code = "wrong_version"
        elif not is_heard and last.reconnects - before.reconnects >= 2:
            # It opens and is thrown out again and again: another protocol, perhaps.
            code = "rejected"
        else:
            return _events("reconnect", reconnects, "reconnects")
        return (HealthFinding(code=code, level="ERROR", message=reason),)

    def _judge_stamps(self, block: Block) -> tuple[HealthFinding, ...]:
        """Check that a device that sends timestamps continues to send them."""
        missing = int(np.count_nonzero(block.t_device_ns < 0))
        if not self._descriptor.capabilities.device_time or not missing:
            return ()
        text = f"{missing} of {len(block)} samples have no device timestamp"
        return (HealthFinding(code="clock_stamps", level="ERROR", message=text),)

    def _judge_arrivals(self, block: Block, now_ns: int) -> Verdict:
        name, rate_hz = self._descriptor.name, self._descriptor.nominal_rate_hz
        t_ns = block.t_host_ns
        if self._last_ns is None and len(t_ns):
            self._last_ns, t_ns = int(t_ns[0]), t_ns[1:]
        steps_s = self._steps.add(t_ns, _steps_s(t_ns, self._last_ns), now_ns)
        if len(t_ns):
            self._last_ns = int(t_ns[-1])
        # One latency a delivery: their own times do not matter within the window.
        when = np.full(len(block.latency_ns), now_ns, dtype=np.int64)
        latencies_s = self._latencies.add(when, block.latency_ns * 1e-9, now_ns)
        figures: dict[str, float] = {}
        findings: tuple[HealthFinding, ...] = ()
        if len(steps_s) and steps_s.sum() * 1e9 >= MIN_RATE_SPAN_NS:
            measured_hz = len(steps_s) / steps_s.sum()
            figures["rate_hz"] = measured_hz
            text = f"{measured_hz:.1f} Hz, expected {rate_hz:g} Hz"
            findings += above("rate", abs(measured_hz / rate_hz - 1.0), RATE_LIMITS, text)
        if len(steps_s) >= MIN_ARRIVALS:
            limits = (LATE_PERIODS[0] / rate_hz, LATE_PERIODS[1] / rate_hz)
            late_s = float(np.percentile(steps_s, 99))
            figures["interarrival_p99_seconds"] = late_s
            # A sequence with single losses has steps of exactly two periods.
            text = f"1 % of samples come more than {late_s * 1e3:.0f} ms after the previous one"
            findings += above("jitter", late_s * 0.99, limits, text)
            gap_s = float(steps_s.max())
            limits = (max(GAP_LIMITS_S[0], GAP_PERIODS / rate_hz), GAP_LIMITS_S[1])
            findings += above("gap", gap_s, limits, f"{gap_s:.2f} s without a sample of {name}")
        if len(latencies_s):
            latency_s = float(np.percentile(latencies_s, 99))
            figures["host_latency_p99_seconds"] = latency_s
            limits = (LATE_PERIODS[0] / rate_hz, LATE_PERIODS[1] / rate_hz)
            text = f"1 % of samples are delayed by {latency_s * 1e3:.0f} ms in this host"
            findings += above("latency", latency_s, limits, text)
        return Verdict(findings, figures)


def _steps_s(t_ns: np.ndarray, last_ns: int | None) -> np.ndarray:
    if last_ns is None or not len(t_ns):
        return np.empty(0)
    return np.diff(np.concatenate([[last_ns], t_ns])) * 1e-9


def _events(code: Code, count: int, words: str) -> tuple[HealthFinding, ...]:
    if count <= 0:
        return ()
    return (HealthFinding(code=code, level="WARN", message=f"{count} {words}"),)
