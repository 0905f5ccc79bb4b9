"""Health check of a device's clock: skew, residual and steps relative to the station's clock.

Runs at the evaluation, never in the reader. For devices without timestamps and sequence numbers,
the expected number of samples serves as the clock.
"""

from collections import deque

import numpy as np

from dextouch.clocks import CountingClock, OnlineClock
from dextouch.errors import InvalidInputError
from dextouch.streams import StreamDescriptor, residual_limits_s
from services.acquisition.health.codes import CODES
from services.acquisition.health.evaluation import Block, Evaluation, Rolling

STEP_NS = 4_000_000
HOUR_NS = 3_600_000_000_000
STEP_SHOWN_NS = 60_000_000_000
# A step is detected in two ways; detections within this time are the same step.
SAME_STEP_NS = 2_500_000_000
MIN_RESIDUALS = 30
OFFSET_SPAN_NS = 1_000_000_000
# Before the clock has a slope of its own, two halves of so many samples give a first one.
MIN_EARLY_SAMPLES = 40
# Arrivals that a busy host delays tilt the line of so young a clock: parts of them must agree.
YOUNG_NS = 20_000_000_000
SKEW_PARTS = 4
# A nominal rate may be off by so much, which adds up where many samples are missing.
RATE_SHARE = 0.02
# The smallest step that the line finds is 1 ms; a step shows in the distance of two stamps.
DEPARTURE_NS = 500_000
BORNE_OUT_NS = 5_000_000_000
BINS = 10


class ClockCheck:
    """Checks one device's clock on the first of its streams (all share their timestamps)."""

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self._descriptor = descriptor
        self._restart()
        self._residuals = Rolling()
        self._drift_ns = 0
        self._offsets = Rolling()
        self._steps: deque[int] = deque(maxlen=64)
        self.num_steps = 0
        self._latest = Evaluation(0)

    def _restart(self) -> None:
        self._clock = OnlineClock(self._descriptor)
        self._known_steps = 0
        # Arrival, device time and sequence of the newest sample.
        self._last = np.empty((3, 0), dtype=np.int64)
        self._departed_ns: int | None = None
        self._since_ns: int | None = None

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        self._latest = Evaluation(evaluation.now_ns, evaluation.block)
        if len(evaluation.block):
            self._judge_block(self._latest)
        self._judge_steps(self._latest)
        evaluation.include(self._latest)

    def repeat(self, evaluation: Evaluation) -> None:
        """The latest result, which holds for all streams of the device."""
        evaluation.include(self._latest)

    def _judge_block(self, evaluation: Evaluation) -> None:
        block = evaluation.block
        for t_ns in self._jumps(block):
            self._note(t_ns)
        try:
            residuals_ns = self._follow(block)
        except InvalidInputError as error:
            self._restart()
            evaluation.judge("clock_stamps", 1, error.message)
            return
        kept_s = self._residuals.add(block.t_host_ns, residuals_ns * 1e-9, evaluation.now_ns)
        skew_ppm = self._skew_ppm(int(block.t_host_ns[-1]))
        evaluation.figures["clock_skew_ratio"] = skew_ppm * 1e-6
        text = f"its clock is skewed by {skew_ppm:+.0f} ppm"
        evaluation.judge("clock_skew", abs(skew_ppm), text)
        newest = self._offsets.values[self._offsets.t_ns >= evaluation.now_ns - OFFSET_SPAN_NS]
        if len(newest):
            # The least delayed arrival shows the offset best.
            evaluation.figures["clock_offset_seconds"] = float(newest.min()) * 1e-9
        if len(kept_s) >= MIN_RESIDUALS:
            _judge_scatter(evaluation, kept_s, "its clock")

    def _follow(self, block: Block) -> np.ndarray:
        """Arrival minus estimated time of each sample, ns."""
        stamps = np.stack([block.t_host_ns, block.t_device_ns, block.sequence], axis=1)
        times_ns = [
            self._clock.update(t_host_ns=t_host_ns, t_device_ns=t_device_ns, sequence=sequence)
            for t_host_ns, t_device_ns, sequence in stamps.tolist()
        ]
        if self._clock.num_steps > self._known_steps:
            self._known_steps = self._clock.num_steps
            # Arrivals that a busy host delays for long look like a step; the stamps tell.
            t_ns, departed_ns = int(block.t_host_ns[-1]), self._departed_ns
            if departed_ns is not None and t_ns - departed_ns < BORNE_OUT_NS:
                self._note(t_ns)
        return block.t_host_ns - np.array(times_ns, dtype=np.int64)

    def _jumps(self, block: Block) -> list[int]:
        """Arrivals at which the device's stamp departs from its sequence and from the host."""
        capabilities = self._descriptor.capabilities
        new = np.stack([block.t_host_ns, block.t_device_ns, block.sequence])
        stamps = np.concatenate([self._last, new], axis=1)
        self._last = stamps[:, -1:]
        host_ns, device_ns, numbers = np.diff(stamps, axis=1)
        t_host_ns, period_ns = stamps[0, 1:], self._descriptor.period_ns()
        if capabilities.sequence:
            numbers = _signed(numbers, capabilities.sequence_bits, 1)
        else:
            numbers = np.ones_like(numbers)
        departed, jumped = numbers != 1, np.zeros(len(numbers), dtype=np.bool_)
        if stamps[1].min() >= 0:
            device_ns = _signed(device_ns, capabilities.device_time_bits, capabilities.tick_ns)
            off_ns = np.abs(device_ns - numbers * period_ns)
            departed = (off_ns > DEPARTURE_NS + capabilities.tick_ns) | (numbers < 1)
            offsets_ns = np.cumsum(np.append(self._drift_ns, host_ns - device_ns))
            self._drift_ns = int(offsets_ns[-1])
            self._offsets.add(t_host_ns, offsets_ns[1:], int(stamps[0, -1]))
            off_sequence = off_ns > STEP_NS + RATE_SHARE * period_ns * (numbers - 1)
            off_host = np.abs(device_ns - host_ns) > STEP_NS
            jumped = off_sequence & off_host & (numbers > 0) & capabilities.sequence
        if departed.any():
            # Samples were not as far apart as their numbers say.
            self._departed_ns = int(t_host_ns[departed][-1])
        return [int(t_ns) for t_ns in t_host_ns[jumped]]

    def _skew_ppm(self, t_host_ns: int) -> float:
        """The line's slope; of a young clock only where the edges of all parts bear it out."""
        if self._since_ns is None:
            self._since_ns = t_host_ns
        slope_ppm = self._clock.skew_ppm
        if slope_ppm != 0.0 and t_host_ns - self._since_ns >= YOUNG_NS:
            return slope_ppm
        early_ppm = self._early_skew_ppm()
        is_borne_out = slope_ppm * early_ppm > 0 and abs(early_ppm) > 0.5 * abs(slope_ppm)
        return slope_ppm if is_borne_out else early_ppm

    def _early_skew_ppm(self) -> float:
        """Slope of the offsets' lower edge that all parts of the window show, minus its error."""
        offsets_ns, t_ns = self._offsets.values, self._offsets.t_ns
        if len(t_ns) < MIN_EARLY_SAMPLES or self._steps:
            return 0.0
        parts = np.array_split(offsets_ns, SKEW_PARTS)
        edges_ns = np.array([part.min() for part in parts])
        span_s = (t_ns[-1] - t_ns[0]) * 1e-9 / SKEW_PARTS
        slopes_ppm = np.diff(edges_ns) * 1e-3 / span_s
        if slopes_ppm.min() * slopes_ppm.max() <= 0:
            return 0.0
        # Late arrivals raise an edge for a while; what the whole window does, each part does.
        above_ns = np.mean([np.mean(part - part.min()) for part in parts])
        uncertainty_ppm = 4.0 * above_ns * 1e-3 / len(offsets_ns) / span_s
        slope_ppm = slopes_ppm[np.argmin(np.abs(slopes_ppm))]
        return float(np.sign(slope_ppm) * max(0.0, abs(slope_ppm) - uncertainty_ppm))

    def _note(self, t_ns: int) -> None:
        if not self._steps or t_ns - self._steps[-1] >= SAME_STEP_NS:
            self._steps.append(t_ns)
            self.num_steps += 1

    def _judge_steps(self, evaluation: Evaluation) -> None:
        evaluation.figures["clock_resets"] = float(self.num_steps)
        in_an_hour = sum(t_ns > evaluation.now_ns - HOUR_NS for t_ns in self._steps)
        is_new = bool(self._steps) and self._steps[-1] > evaluation.now_ns - STEP_SHOWN_NS
        if is_new or in_an_hour >= CODES["clock_step"].error:
            text = f"its clock was set or restarted {in_an_hour} times within an hour"
            evaluation.judge("clock_step", in_an_hour, text)


class CountingCheck:
    """Judges a stream without time and number: its clock is the count of its samples.

    The nominal period may be off by percents, so that skew is told and `rate` judges it; losses
    that were miscounted look like resets, so that these are told too and are no step. What is sent
    unsteadily has no clock to judge.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self._period_ns = descriptor.period_ns()
        self._limits_s = residual_limits_s(self._period_ns * 1e-9)
        self._residuals = Rolling()
        self._num_resets = 0
        self._restart()

    def _restart(self) -> None:
        self._clock = CountingClock(self._period_ns)
        self._undated: deque[int] = deque()

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        try:
            arrivals_ns, residuals_ns = self._follow(evaluation.block)
        except InvalidInputError:
            # Arrivals that go back: another reader, another clock.
            self._num_resets += 1 + self._clock.num_steps
            self._restart()
            return
        kept_s = self._residuals.add(arrivals_ns, residuals_ns * 1e-9, evaluation.now_ns)
        has_enough = len(evaluation.block) and len(kept_s) >= MIN_RESIDUALS
        if has_enough and self._clock.is_steady:
            num_resets = self._num_resets + self._clock.num_steps
            evaluation.figures["clock_resets"] = float(num_resets)
            evaluation.figures["clock_skew_ratio"] = self._clock.skew_ppm * 1e-6
            about = "the count of its samples"
            _judge_scatter(evaluation, kept_s, about, at_least=self._limits_s)

    def _follow(self, block: Block) -> tuple[np.ndarray, np.ndarray]:
        """Arrivals of the samples that got their final time now, and how long they waited, ns."""
        arrivals_ns: list[int] = []
        residuals_ns: list[int] = []
        for t_host_ns in block.t_host_ns.tolist():
            self._undated.append(t_host_ns)
            for dated in self._clock.advance(t_host_ns):
                arrivals_ns.append(self._undated.popleft())
                residuals_ns.append(arrivals_ns[-1] - dated.t_host_ns)
        return np.array(arrivals_ns, dtype=np.int64), np.array(residuals_ns, dtype=np.int64)


def _judge_scatter(
    evaluation: Evaluation,
    residuals_s: np.ndarray,
    about: str,
    *,
    at_least: tuple[float, float] = (0.0, 0.0),
) -> None:
    """How far 95 % lie from the median, which is path delay and cannot be told from offset.

    The figure of the offset's scatter is how far the lower edge of the residuals moves from second
    to second.
    """
    scatter_s = float(np.percentile(np.abs(residuals_s - np.median(residuals_s)), 95))
    edges_s = [part.min() for part in np.array_split(residuals_s, BINS)]
    sigma_s = float(1.4826 * np.median(np.abs(edges_s - np.median(edges_s))))
    evaluation.figures["clock_residual_p95_seconds"] = scatter_s
    evaluation.figures["clock_sigma_seconds"] = sigma_s
    text = f"arrivals scatter by {scatter_s * 1e3:.1f} ms about {about}"
    evaluation.judge("clock_residual", scatter_s, text, at_least=at_least)


def _signed(steps: np.ndarray, bits: int, unit: int) -> np.ndarray:
    """Steps of a counter that wraps, as small signed numbers."""
    modulus = 2**bits * unit
    if modulus > 2**62:
        return steps
    return (steps + modulus // 2) % modulus - modulus // 2
