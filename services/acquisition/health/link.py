"""Health check of a stream's link: its rate, loss, damage, gaps and lateness."""

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np

from dextouch.streams import StreamDescriptor
from services.acquisition.health.evaluation import (
    WINDOW_NS,
    CountWindow,
    Evaluation,
    Finding,
    Rolling,
)
from services.acquisition.supervisor import DeviceSupervisor

GAP_PERIODS = 3
MIN_RATE_SPAN_S = 0.9
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
        self._counters = supervisor.streams[descriptor.name]
        self._is_settled = False
        self._last: Mapping[str, int] | None = None
        self._counts = CountWindow(self._count)
        self._steps = Rolling()
        self._latencies = Rolling()
        self._last_ns = np.empty(0, dtype=np.int64)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        self._judge_counts(evaluation, self._counts.growth(evaluation.now_ns))
        if self._descriptor.capabilities.device_time:
            stamps_ns = evaluation.block.t_device_ns
            missing = int(np.count_nonzero(stamps_ns < 0))
            text = f"{missing} of {len(stamps_ns)} samples have no device timestamp"
            evaluation.judge("clock_stamps", missing, text)
        self._judge_arrivals(evaluation)

    def _count(self) -> Mapping[str, int]:
        """Everything countable about the stream's device at this moment."""
        counts = {
            **self._supervisor.events(),
            "samples": self._counters.num_samples,
            "reconnects": self._supervisor.reconnects,
            "skipped_bytes": 0,
        }
        last, self._last = self._last or counts, counts
        # Bytes skipped so far, without those of the search that each opening begins with.
        is_settled = self._is_settled
        if counts["reconnects"] != last["reconnects"]:
            self._is_settled = is_settled = False
        elif counts["samples"] > last["samples"]:
            self._is_settled = True
        num_skipped = counts["resync_bytes"] - last["resync_bytes"] if is_settled else 0
        counts["skipped_bytes"] = last["skipped_bytes"] + num_skipped
        return counts

    def _judge_counts(self, evaluation: Evaluation, grown: Counter[str]) -> None:
        expected = round(self._descriptor.nominal_rate_hz * WINDOW_NS * 1e-9)
        packets = max(expected, grown["packets"] + grown["lost"])
        for code, counters, words, figure in SHARES:
            # A late packet is no longer counted as lost once it arrives.
            count = max(0, sum(grown[name] for name in counters))
            share = count / packets
            evaluation.judge(code, share, words.format(share=share, count=count))
            if figure is not None:
                evaluation.figures[figure] = share
        for code, counter, words in EVENTS:
            evaluation.judge(code, grown[counter], f"{grown[counter]} {words}")
        self._judge_connection(evaluation, grown)
        if grown["skipped_bytes"] and not evaluation.figures["damaged_ratio"]:
            message = f"{grown['skipped_bytes']} bytes skipped between packets"
            evaluation.findings.append(Finding("damage", "WARN", message))

    def _judge_connection(self, evaluation: Evaluation, grown: Counter[str]) -> None:
        reason = self._supervisor.last_error or "the driver rejects its packets"
        for code in ("wrong_side", "wrong_version"):
            if grown[code]:
                evaluation.judge(code, grown[code], reason)
                return
        history = [counts for _, counts in self._counts.history]
        last = history[-1]
        heard = [counts for counts in history if counts["samples"] < last["samples"]]
        before = heard[-1] if heard else history[0]
        heard_ns = self._counters.last_t_host_ns
        is_heard = heard_ns is not None and evaluation.now_ns - heard_ns < SILENT_NS
        if not is_heard and last["reconnects"] - before["reconnects"] >= 2:
            # It opens and is thrown out again and again: another protocol, perhaps.
            evaluation.judge("rejected", 1, reason)
        else:
            evaluation.judge("reconnect", grown["reconnects"], f"{grown['reconnects']} reconnects")

    def _judge_arrivals(self, evaluation: Evaluation) -> None:
        rate_hz, block, figures = (
            self._descriptor.nominal_rate_hz,
            evaluation.block,
            evaluation.figures,
        )
        t_ns = np.concatenate([self._last_ns, block.t_host_ns])
        self._last_ns = t_ns[-1:]
        steps_s = self._steps.add(t_ns[1:], np.diff(t_ns) * 1e-9, evaluation.now_ns)
        if steps_s.sum() >= MIN_RATE_SPAN_S:
            measured_hz = figures["rate_hz"] = len(steps_s) / float(steps_s.sum())
            text = f"{measured_hz:.1f} Hz, expected {rate_hz:g} Hz"
            evaluation.judge("rate", abs(measured_hz / rate_hz - 1.0), text)
        if len(steps_s) >= MIN_ARRIVALS:
            late_s = figures["interarrival_p99_seconds"] = float(np.percentile(steps_s, 99))
            # A sequence with single losses has steps of exactly two periods.
            text = f"1 % of samples come more than {late_s * 1e3:.0f} ms after the previous one"
            evaluation.judge("jitter", late_s * 0.99 * rate_hz, text)
            gap_s = float(steps_s.max())
            text = f"{gap_s:.2f} s without a sample of {self._descriptor.name}"
            evaluation.judge("gap", gap_s, text, at_least=(GAP_PERIODS / rate_hz, 0.0))
        latencies_s = self._latencies.add(
            block.t_host_ns, block.latency_ns * 1e-9, evaluation.now_ns
        )
        if len(latencies_s):
            late_s = figures["host_latency_p99_seconds"] = float(np.percentile(latencies_s, 99))
            text = f"1 % of samples are delayed by {late_s * 1e3:.0f} ms in this host"
            evaluation.judge("latency", late_s * rate_hz, text)


class TrackingJudge:
    """Checks the packets that a tracker's decoder dropped: occluded, jumped, stale.

    Args:
        count: the counters of the device.
    """

    def __init__(self, count: Callable[[], Mapping[str, int]]) -> None:
        self._counts = CountWindow(count)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        grown = self._counts.growth(evaluation.now_ns)
        packets = max(MIN_TRACKED_PACKETS, grown["packets"])
        lost, jumped = (grown["occluded"] + grown["stale"]) / packets, grown["jumped"]
        evaluation.judge("tracking", lost, f"not tracked for {lost:.0%} of 10 s")
        evaluation.judge("jump", jumped / packets, f"{jumped} jumps dropped within 10 s")
        evaluation.figures["tracking_lost_ratio"] = lost
