"""Health check of a stream's link: its rate, loss, damage, gaps and lateness."""

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np

from dextouch.streams import StreamDescriptor
from services.acquisition.health.levels import Finding, Verdict, find
from services.acquisition.health.samples import WINDOW_NS, Block, CountWindow, Rolling
from services.acquisition.supervisor import DeviceSupervisor

GAP_PERIODS = 3
MIN_RATE_SPAN_NS = 900_000_000
MIN_ARRIVALS = 20
SILENT_NS = 200_000_000
# Ratios of a tracker's first moments after a start say nothing.
MIN_TRACKED_PACKETS = 100
# What is judged as a share of the packets: code, counters, words, figure.
SHARES = (
    ("loss", ("lost",), "{share:.1%} of packets lost", "drop_ratio"),
    ("damage", ("crc_errors", "length_errors"), "{count} packets damaged", "damaged_ratio"),
    ("refused", ("refused",), "{count} packets without a sample", "refused_ratio"),
    ("suspect", ("suspects",), "{count} packets held back", "suspect_ratio"),
    ("queue", ("queue",), "{count} images dropped from a full queue", None),
)
# What counts as soon as it happens: code, counter, words.
EVENTS = (
    ("repeated", "repeated", "duplicate packets"),
    ("reordered", "late", "late packets dropped"),
    ("restart", "restarts", "restarts of the device"),
)


class LinkJudge:
    """Checks the last 10 s of one stream on its path from the device to the spool."""

    def __init__(self, supervisor: DeviceSupervisor, descriptor: StreamDescriptor) -> None:
        self._supervisor = supervisor
        self._descriptor = descriptor
        self._is_settled = False
        self._last: Mapping[str, int] | None = None
        self._counts = CountWindow(self._count)
        self._steps = Rolling(WINDOW_NS)
        self._latencies = Rolling(WINDOW_NS)
        self._last_ns: int | None = None

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        counted = self._judge_counts(self._counts.growth(now_ns), now_ns)
        arrivals = self._judge_arrivals(block, now_ns)
        findings = counted.findings + self._judge_stamps(block) + arrivals.findings
        return Verdict(findings, {**counted.figures, **arrivals.figures})

    def _count(self) -> Mapping[str, int]:
        """Everything countable about the stream's device at this moment."""
        counts = {
            **self._supervisor.events(),
            "samples": self._supervisor.streams[self._descriptor.name].num_samples,
            "reconnects": self._supervisor.reconnects,
            "skipped_bytes": 0,
        }
        last, self._last = self._last, counts
        if last is None:
            return counts
        # Bytes skipped so far, without those of the search that each opening begins with.
        is_settled = self._is_settled
        if counts["reconnects"] != last["reconnects"]:
            self._is_settled = is_settled = False
        elif counts["samples"] > last["samples"]:
            self._is_settled = True
        num_skipped = counts["resync_bytes"] - last["resync_bytes"] if is_settled else 0
        counts["skipped_bytes"] = last["skipped_bytes"] + num_skipped
        return counts

    def _judge_counts(self, grown: Counter[str], now_ns: int) -> Verdict:
        expected = round(self._descriptor.nominal_rate_hz * WINDOW_NS * 1e-9)
        packets = max(expected, grown["packets"] + grown["lost"])
        findings: tuple[Finding, ...] = ()
        figures: dict[str, float] = {}
        for code, counters, words, figure in SHARES:
            # A late packet is no longer counted as lost once it arrives.
            count = max(0, sum(grown[name] for name in counters))
            share = count / packets
            findings += find(code, share, words.format(share=share, count=count))
            if figure is not None:
                figures[figure] = share
        for code, counter, words in EVENTS:
            findings += find(code, grown[counter], f"{grown[counter]} {words}")
        findings += self._judge_connection(grown, now_ns)
        num_skipped = grown["skipped_bytes"]
        if num_skipped and not figures["damaged_ratio"]:
            message = f"{num_skipped} bytes skipped between packets"
            findings += (Finding("damage", "WARN", message),)
        return Verdict(findings, figures)

    def _judge_connection(self, grown: Counter[str], now_ns: int) -> tuple[Finding, ...]:
        reason = self._supervisor.last_error or "the driver rejects its packets"
        for code in ("wrong_side", "wrong_version"):
            if grown[code]:
                return find(code, grown[code], reason)
        history = [counts for _, counts in self._counts.history]
        last = history[-1]
        heard = [counts for counts in history if counts["samples"] < last["samples"]]
        before = heard[-1] if heard else history[0]
        heard_ns = self._supervisor.streams[self._descriptor.name].last_t_host_ns
        is_heard = heard_ns is not None and now_ns - heard_ns < SILENT_NS
        if not is_heard and last["reconnects"] - before["reconnects"] >= 2:
            # It opens and is thrown out again and again: another protocol, perhaps.
            return find("rejected", 1, reason)
        return find("reconnect", grown["reconnects"], f"{grown['reconnects']} reconnects")

    def _judge_stamps(self, block: Block) -> tuple[Finding, ...]:
        """Check that a device that sends timestamps continues to send them."""
        missing = int(np.count_nonzero(block.t_device_ns < 0))
        if not self._descriptor.capabilities.device_time:
            return ()
        text = f"{missing} of {len(block)} samples have no device timestamp"
        return find("clock_stamps", missing, text)

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
        findings: tuple[Finding, ...] = ()
        if len(steps_s) and steps_s.sum() * 1e9 >= MIN_RATE_SPAN_NS:
            measured_hz = len(steps_s) / steps_s.sum()
            figures["rate_hz"] = measured_hz
            text = f"{measured_hz:.1f} Hz, expected {rate_hz:g} Hz"
            findings += find("rate", abs(measured_hz / rate_hz - 1.0), text)
        if len(steps_s) >= MIN_ARRIVALS:
            late_s = float(np.percentile(steps_s, 99))
            figures["interarrival_p99_seconds"] = late_s
            # A sequence with single losses has steps of exactly two periods.
            text = f"1 % of samples come more than {late_s * 1e3:.0f} ms after the previous one"
            findings += find("jitter", late_s * 0.99 * rate_hz, text)
            gap_s = float(steps_s.max())
            text = f"{gap_s:.2f} s without a sample of {name}"
            findings += find("gap", gap_s, text, at_least=(GAP_PERIODS / rate_hz, 0.0))
        if len(latencies_s):
            latency_s = float(np.percentile(latencies_s, 99))
            figures["host_latency_p99_seconds"] = latency_s
            text = f"1 % of samples are delayed by {latency_s * 1e3:.0f} ms in this host"
            findings += find("latency", latency_s * rate_hz, text)
        return Verdict(findings, figures)


def _steps_s(t_ns: np.ndarray, last_ns: int | None) -> np.ndarray:
    if last_ns is None or not len(t_ns):
        return np.empty(0)
    return np.diff(np.concatenate([[last_ns], t_ns])) * 1e-9


class TrackingJudge:
    """Checks the packets that a tracker's decoder dropped: occluded, jumped, stale.

    Args:
        count: the counters of the device.
    """

    def __init__(self, count: Callable[[], Mapping[str, int]]) -> None:
        self._counts = CountWindow(count)

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        del block
        grown = self._counts.growth(now_ns)
        packets = max(MIN_TRACKED_PACKETS, grown["packets"])
        lost, jumped = (grown["occluded"] + grown["stale"]) / packets, grown["jumped"]
        findings = (
            *find("tracking", lost, f"not tracked for {lost:.0%} of 10 s"),
            *find("jump", jumped / packets, f"{jumped} jumps dropped within 10 s"),
        )
        return Verdict(findings, {"tracking_lost_ratio": lost})
