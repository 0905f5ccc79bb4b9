"""Health checks of one stream: its link (rate, loss, gaps, lateness) and its values."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np

from dextouch.geometry import nearest_index, pose_from_transform, transform_from_pose
from dextouch.schemas import Matrix
from dextouch.streams import (
    BODIES,
    IMAGE_FAULTS,
    MOUNTS,
    TAXEL_UNIT,
    TRACKERS,
    TURNED_RAD,
    HandTraces,
    ImplausibleBody,
    Sample,
    StreamDescriptor,
    implausible_bodies,
    implausible_values,
    turned_rad,
)
from services.acquisition.drivers.base import Driver
from services.acquisition.health.evaluation import (
    WINDOW_NS,
    Block,
    CountWindow,
    Evaluation,
    Finding,
    Rolling,
)
from services.acquisition.health.glove_records import glove_record, refused_taxels
from services.acquisition.supervisor import DeviceSupervisor

GAP_PERIODS = 3
MIN_RATE_SPAN_S = 0.9
MIN_ARRIVALS = 20
MIN_LATE = 3
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
MAX_SPEED_M_S = 5.0
REST_SPEED_M_S = 0.02
REST_NS = 1_000_000_000
MIN_REST_SAMPLES = 40
# Long enough for a hundred samples of most trackers, and short enough to show a change soon.
PLAUSIBLE_NS = 5_000_000_000
# A content that stays for longer while its camera moves is none of now.
MIN_STILL_S = 1.5
# What a camera shows is told of pictures as new as this; those of H.264 are up to 8 images late.
FRESH_NS, ENCODER_NS = 1_000_000_000, 300_000_000
# Poses of bodies that are compared of that time.
MAX_COMPARED = 100
# Half seconds in which motion and touch of hands are compared.
HAND_BINS = 120
# What is kept between two evaluations, which are a second apart.
KEPT_S = 4.0
JUDGED_VALUES = ("tactile", "pose", "keypoints", "robot_state")


class LinkCheck:
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
        for code, counters, text, figure in SHARES:
            # A late packet is no longer counted as lost once it arrives.
            count = max(0, sum(grown[name] for name in counters))
            share = count / packets
            evaluation.judge(code, share, text.format(share=share, count=count))
            if figure is not None:
                evaluation.figures[figure] = share
        for code, counter, text in EVENTS:
            evaluation.judge(code, grown[counter], f"{grown[counter]} {text}")
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
            # Of few samples, three late ones at least: a busy host delays one now and then.
            share = 100 * min(0.99, 1 - MIN_LATE / len(steps_s))
            late_s = figures["interarrival_p99_seconds"] = float(np.percentile(steps_s, share))
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


class TrackingCheck:
    """Checks the packets that a tracker's decoder dropped: occluded, jumped, stale."""

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


class PoseCheck:
    """Judges the poses of one body: jumps that came through, and its trembling at rest."""

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self._descriptor = descriptor
        self._jumps = Rolling()
        # The last second, by the device's clock where it has one.
        self._t_ns = np.empty(0, dtype=np.int64)
        self._positions_m = np.empty((0, 3))

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        block = evaluation.block
        if block.values is None or not len(block):
            return
        times_ns = block.t_device_ns
        if not self._descriptor.capabilities.device_time or times_ns.min() < 0:
            times_ns = block.t_host_ns
        t_ns = np.concatenate([self._t_ns, times_ns])
        positions_m = np.concatenate([self._positions_m, block.values[:, :3].astype(np.float64)])
        steps_s = np.diff(t_ns)[-len(block) :] * 1e-9
        steps_m = np.linalg.norm(np.diff(positions_m, axis=0)[-len(block) :], axis=1)
        # A step back of the clock says nothing about speed.
        jumped = (steps_s > 0) & (steps_m > MAX_SPEED_M_S * steps_s)
        when_ns = block.t_host_ns[len(block) - len(jumped) :]
        shares = self._jumps.add(when_ns, jumped, evaluation.now_ns)
        share = float(shares.mean()) if len(shares) else 0.0
        text = f"{share:.1%} of its steps are faster than {MAX_SPEED_M_S:g} m/s"
        evaluation.judge("jump", share, text)
        kept = (t_ns >= t_ns[-1] - REST_NS) & (t_ns <= t_ns[-1])
        self._t_ns, self._positions_m = t_ns[kept], positions_m[kept]
        jitter_m = self._jitter_m()
        if jitter_m is not None:
            evaluation.figures["stationary_jitter_meters"] = jitter_m
            text = f"jitters by {jitter_m * 1e3:.1f} mm at rest"
            evaluation.judge("pose_jitter", jitter_m, text)

    def _jitter_m(self) -> float | None:
        """RMS about a parabola through the last second; None unless the body rests."""
        if len(self._t_ns) < MIN_REST_SAMPLES:
            return None
        t_s = (self._t_ns - self._t_ns[-1]) * 1e-9
        basis = np.vander(t_s, 3, increasing=True)
        fitted, *_ = np.linalg.lstsq(basis, self._positions_m, rcond=None)
        speeds_m_s = np.linalg.norm(fitted[1] + 2 * t_s[:, None] * fitted[2], axis=1)
        if speeds_m_s.mean() > REST_SPEED_M_S:
            return None
        errors_m = self._positions_m - basis @ fitted
        return float(np.sqrt((errors_m**2).sum(axis=1).mean()))


class PlausibilityCheck:
    """Judges whether the values of the last 5 s can be true, by the rules that alignment has.

    A robot may stand still exactly.
    """

    def __init__(self, descriptor: StreamDescriptor, *, of_robot: bool = False) -> None:
        self._descriptor, self._of_robot = descriptor, of_robot
        # The value at which it was found frozen, which of its numbers were, and since when.
        self._frozen: tuple[np.ndarray, np.ndarray, int] | None = None
        self._blocks: deque[tuple[np.ndarray, np.ndarray]] = deque()

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        block, blocks = evaluation.block, self._blocks
        if block.values is not None and len(block):
            blocks.append((block.t_host_ns, block.values))
        while blocks and blocks[0][0][-1] < evaluation.now_ns - PLAUSIBLE_NS:
            blocks.popleft()
        if not blocks:
            return
        t_ns, values = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        if self._frozen is not None and (values[-1] == self._frozen[0])[self._frozen[1]].all():
            # By now the window may hold nothing else.
            lasted_s = (t_ns[-1] - self._frozen[2]) * 1e-9
            evaluation.judge("frozen", lasted_s, f"values are frozen for {lasted_s:.0f} s")
            return
        self._frozen = None
        found = implausible_values(self._descriptor, t_ns, values, of_robot=self._of_robot)
        for one in found:
            if one.cause == "repeated" or one.harmless:
                evaluation.findings.append(Finding("frozen", "WARN", one.message))
            elif one.cause == "frozen" and not one.whole:
                lasted_s = float(one.samples.sum()) * self._descriptor.period_ns() * 1e-9
                evaluation.judge("frozen", lasted_s, one.message)
                same = values[-1] == values[-2]
                if one.samples[-1] and same.any():
                    self._frozen = values[-1], same, int(t_ns[np.flatnonzero(~one.samples)[-1]])
            elif one.cause != "jump":
                # Single jumps have a code of their own.
                level: Literal["WARN", "ERROR"] = "ERROR" if one.whole else "WARN"
                evaluation.findings.append(Finding("implausible", level, one.message))


class BodiesCheck:
    """Judges whether head and wrists of the last 5 s are those of one body, as alignment does.

    One for all of a person's trackers; each stream is told what is wrong with it. `calibration` has
    the mounts of trackers on their bodies.
    """

    def __init__(self, calibration: Mapping[str, Matrix]) -> None:
        self._mounts = {
            name: np.asarray(calibration[mount], dtype=np.float64)
            for name, mount in MOUNTS.items()
            if mount in calibration
        }
        self._poses: dict[str, deque[tuple[np.ndarray, np.ndarray]]] = {n: deque() for n in BODIES}
        self._found: ImplausibleBody | None = None
        self._found_ns = -1

    def of(self, name: str) -> Callable[[Evaluation], None]:
        """The check of one stream."""
        return partial(self._judge, name)

    def turned_rad(self, name: str, since_ns: int, until_ns: int) -> float:
        """By how much a tracker turned (in the last 5 s), or moved past what is 1 m away."""
        poses = [
            values[(t_ns >= since_ns) & (t_ns <= until_ns)]
            for t_ns, values in self._poses.get(name, ())
        ]
        if not sum(map(len, poses)):
            return 0.0
        Ts = transform_from_pose(np.concatenate(poses).astype(np.float64))
        return float(turned_rad(Ts[:1], Ts).max())

    def _judge(self, name: str, evaluation: Evaluation) -> None:
        block = evaluation.block
        if block.values is not None and len(block):
            self._poses[name].append((block.t_host_ns, block.values))
        # All streams are evaluated in turn.
        if evaluation.now_ns != self._found_ns:
            self._found, self._found_ns = self._implausible(evaluation.now_ns), evaluation.now_ns
        if self._found is not None and self._found.stream == name:
            evaluation.findings.append(Finding("implausible", "ERROR", self._found.message))

    def _implausible(self, now_ns: int) -> ImplausibleBody | None:
        for blocks in self._poses.values():
            while blocks and blocks[0][0][-1] < now_ns - PLAUSIBLE_NS:
                blocks.popleft()
        if not all(self._poses.values()):
            return None
        known = {
            n: [np.concatenate(p) for p in zip(*b, strict=True)] for n, b in self._poses.items()
        }
        grid_ns = known["head"][0][:: max(1, len(known["head"][0]) // MAX_COMPARED)]
        poses = {n: v[nearest_index(t_ns, grid_ns)] for n, (t_ns, v) in known.items()}
        to_body = {n: partial(_mounted, T=T) for n, T in self._mounts.items()}
        return implausible_bodies(poses, to_body, of_robot=False)


class HandsCheck:
    """Judges whether wrists and gloves of the last minute go with their hands, as alignment does.

    One for all of a person's devices; `calibration` has tares and gains of the gloves.
    """

    def __init__(self, calibration: Mapping[str, Matrix]) -> None:
        self._calibration = calibration
        self._traces = HandTraces(HAND_BINS)
        self._found, self._found_ns = self._traces.found(), -1

    def of(self, descriptor: StreamDescriptor) -> Callable[[Evaluation], None]:
        """The check of one stream."""
        record = glove_record(descriptor, self._calibration)
        if record is None:
            return partial(self._judge, descriptor, None)
        refused = refused_taxels(descriptor, self._calibration, record)
        return partial(self._judge, descriptor, partial(record.to_kpa, refused=refused))

    def _judge(
        self,
        descriptor: StreamDescriptor,
        to_kpa: Callable[[np.ndarray], np.ndarray] | None,
        evaluation: Evaluation,
    ) -> None:
        block, layout = evaluation.block, None
        if block.values is None or not len(block):
            return
        values = block.values
        if descriptor.kind == "tactile":
            layout = descriptor.tactile_layout
            if to_kpa is not None:
                values = to_kpa(values.reshape(len(values), -1))
            elif descriptor.unit != TAXEL_UNIT:
                return
        self._traces.add(descriptor.name, block.t_host_ns, values, layout)
        if evaluation.now_ns != self._found_ns:
            self._found, self._found_ns = self._traces.found(), evaluation.now_ns
        cause, message = self._found.get(descriptor.name, ("", ""))
        if cause:
            code = "frozen" if cause == "frozen" else "implausible"
            evaluation.findings.append(Finding(code, "ERROR", message))


def _mounted(poses: np.ndarray, T: np.ndarray) -> np.ndarray:
    return pose_from_transform(transform_from_pose(poses) @ T)


class FiniteCheck:
    """Checks the share of a stream's values that is missing (NaN): nodes not seen, broken cells.

    What never held a number is no part of the device (a glove model's empty cells).
    """

    def __init__(self, code: str, word: str) -> None:
        self._code, self._word = code, word
        self._shares = Rolling()
        self._ever = np.zeros(1, dtype=np.bool_)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        block = evaluation.block
        if block.values is None or not len(block) or block.values.dtype.kind != "f":
            return
        finite = np.isfinite(block.values.reshape(len(block), -1))
        ever = self._ever = self._ever | finite.any(axis=0)
        shares = 1.0 - finite[:, ever].mean(axis=1) if ever.any() else np.ones(len(block))
        ratio = float(self._shares.add(block.t_host_ns, shares, evaluation.now_ns).mean())
        evaluation.figures["missing_ratio"] = ratio
        evaluation.judge(self._code, ratio, f"{ratio:.1%} of the {self._word}")


class CameraCheck:
    """Judges one camera: anything is a warning, and by its rule an error after a second."""

    def __init__(self, driver: Driver, name: str, bodies: BodiesCheck | None = None) -> None:
        self._driver, self._tracker, self._bodies = driver, TRACKERS.get(name, ""), bodies
        self._since_ns: dict[str, int] = {}
        self._newest_ns = 0

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        quality, now_ns = self._driver.quality, evaluation.now_ns
        if quality is None:
            return
        self._newest_ns = int(evaluation.block.t_host_ns.max(initial=self._newest_ns))
        is_fresh = now_ns - self._newest_ns <= FRESH_NS
        fault, clipped = quality.fault if is_fresh else None, quality.clipped_ratio
        frozen, text = quality.frozen, "the same image repeatedly"
        if not frozen and is_fresh and quality.still_s > MIN_STILL_S and self._bodies is not None:
            since_ns = self._newest_ns - round(quality.still_s * 1e9)
            turned = self._bodies.turned_rad(self._tracker, since_ns, self._newest_ns - ENCODER_NS)
            frozen, text = turned > 2 * TURNED_RAD, "shows the same while the camera moves"
        flags = {
            "image_frozen": (frozen, text),
            "image_content": (fault is not None, IMAGE_FAULTS[fault or "torn"]),
            "image_blurred": (quality.blurred, "much less sharp than usual"),
            "image_gap": (quality.gap, "images are missing according to its timestamps"),
            "image_clipped": (quality.clipped, f"{clipped:.0%} of the image black or white"),
        }
        self._since_ns = {
            code: self._since_ns.get(code, now_ns) for code, (is_bad, _) in flags.items() if is_bad
        }
        for code, since_ns in self._since_ns.items():
            # What has only begun has lasted for more than nothing.
            evaluation.judge(code, max(1, now_ns - since_ns) / 1e9, flags[code][1])
        evaluation.figures |= {
            "image_clipped_ratio": clipped,
            "image_frozen": float(frozen),
            "image_blurred": float(quality.blurred),
        }


class SampleQueue:
    """A ring of one stream's newest stamps and values; any thread may add and take.

    A reader appends and goes on; when nobody evaluates, the oldest samples fall out and are
    counted in `num_dropped`. It takes its memory once, whatever waits in it.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self.num_dropped = 0
        self.capacity = max(16, round(KEPT_S * descriptor.nominal_rate_hz))
        self._keeps_values = descriptor.kind in JUDGED_VALUES
        self._stamps = np.zeros((self.capacity, 4), dtype=np.int64)
        # Made of the first sample: its device decides on their type.
        self._values: np.ndarray | None = None
        self._num_added = self._num_taken = 0
        self._lock = threading.Lock()

    def add(self, samples: Sequence[Sample], now_ns: int) -> None:
        """Append a delivery (called by the reader thread, after its samples were spooled)."""
        if self._values is None and self._keeps_values:
            first = samples[0].values
            self._values = np.zeros((self.capacity, *first.shape), dtype=first.dtype)
        with self._lock:
            for sample in samples:
                index, t_host_ns = self._num_added % self.capacity, sample.t_host_ns
                stamps = (t_host_ns, sample.t_device_ns, sample.sequence, now_ns - t_host_ns)
                self._stamps[index] = stamps
                if self._values is not None:
                    self._values[index] = sample.values
                self._num_added += 1
            num_dropped = max(0, self._num_added - self._num_taken - self.capacity)
            self._num_taken += num_dropped
            self.num_dropped += num_dropped

    def take(self) -> Block:
        """Everything that waits, oldest first."""
        with self._lock:
            indices = np.arange(self._num_taken, self._num_added) % self.capacity
            stamps = np.ascontiguousarray(self._stamps[indices].T)
            values = None
            if self._values is not None and len(indices):
                values = self._values[indices]
            self._num_taken = self._num_added
        return Block(stamps[0], stamps[1], stamps[2], stamps[3], values)
