"""Simulated takes of device clocks with ground truth, by scene and seed.

A device samples at its own rate by its own clock; its packets are delayed by queues and bus
polling, keep their order, and some are lost. The true sample times are known.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

# The constant path delay, unobservable from one-way timestamps, is subtracted before scoring.
BASE_DELAY_NS = 2_000_000
# Crystals drift with the room temperature over minutes.
WANDER_PERIOD_S = 120.0
WRONG_S = 0.02
LATE_PATH_S = 60.0
# chrony slews 50 ms in so long: its highest rate is 83 333 ppm.
SLEW_S = 0.6
HOST_ORIGIN_NS = 1_700_000_000_000_000_000
DEVICE_ORIGIN_NS = 987_654_321_000


@dataclass(frozen=True)
class Scene:
    """Parameters of a device's clock and of the path of its packets.

    Attributes:
        rate_hz: samples a second of the device's clock.
        skew_ppm: how much faster the host's clock runs.
        wander_ppm: amplitude of the skew's slow sine.
        jitter_ms: mean of the exponential queueing delay.
        outliers: share of samples delayed by further `outlier_ms` (mean, exponential).
        grid_ms: arrivals are at multiples of it (bus polling, chip timer).
        drops: share of lost samples.
        step_ms: jump of the device's clock in the middle; 0 for none.
        stop_ms: duration of each stop of the device and its clock.
        num_stops: number of stops, evenly spread.
        late_path_ms: additional path delay from the middle on, for a quarter of the take, a minute
            at most.
        slew_ms: what NTP adds to the clock that stamps arrivals, within 0.6 s in the middle. Times
            are wanted on this clock.
        wrong_stamps: share of timestamps that are wrong by +20 ms.
        tick_ns: resolution of the device's timestamps.
    """

    rate_hz: float = 60.0
    skew_ppm: float = 50.0
    wander_ppm: float = 0.0
    jitter_ms: float = 0.8
    outliers: float = 0.01
    outlier_ms: float = 20.0
    grid_ms: float = 1.0
    drops: float = 0.002
    step_ms: float = 0.0
    stop_ms: float = 0.0
    num_stops: int = 1
    late_path_ms: float = 0.0
    slew_ms: float = 0.0
    wrong_stamps: float = 0.0
    tick_ns: int = 1


@dataclass(frozen=True)
class Take:
    """A simulated take: what was recorded of the samples that arrived, and their true times.

    `sequence` is counted by the device; arrivals and true times are on the host's clock.
    `step_true_ns` is the time of the clock step; None if there is none.
    """

    scene: Scene
    sequence: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    t_host_ns: Int64[np.ndarray, " n"]
    true_ns: Int64[np.ndarray, " n"]
    step_true_ns: int | None

    def __len__(self) -> int:
        return len(self.true_ns)


SCENES = {
    "base": Scene(),
    "serial timer 16 ms": Scene(grid_ms=16.0),
    "5 % outliers 50 ms": Scene(outliers=0.05, outlier_ms=50.0),
    "congestion 5 ms": Scene(jitter_ms=5.0),
    "step +200 ms": Scene(step_ms=200.0),
    "step -30 ms": Scene(step_ms=-30.0),
    "wander 5 ppm": Scene(wander_ppm=5.0),
}
# Not among the seven: coarse timestamps, and steps that are smaller than the delays.
MORE_SCENES = {
    "stamps of 1 ms": Scene(tick_ns=1_000_000),
    "step -9 ms": Scene(step_ms=-9.0),
    "step -3 ms": Scene(step_ms=-3.0),
    "restart -5 s": Scene(step_ms=-5000.0),
}
# Violations of the assumptions that delays only add and clocks never stop.
STOP_SCENES = {
    "stop 50 ms": Scene(stop_ms=50.0),
    "stop 500 ms": Scene(stop_ms=500.0),
    "stop 3 s": Scene(stop_ms=3000.0),
    "5 stops of 80 ms": Scene(stop_ms=80.0, num_stops=5),
    "path +20 ms for a minute": Scene(late_path_ms=20.0),
    "0.2 % of stamps +20 ms": Scene(wrong_stamps=0.002),
}
# Stations stamp with CLOCK_MONOTONIC_RAW, which no daemon slews; CLOCK_BOOTTIME is slewed.
SLEW_SCENES = {
    "NTP +50 ms: raw clock": Scene(),
    "NTP +50 ms: boot clock": Scene(slew_ms=50.0),
}
# For streams without timestamps, whose only difficulty is the number of lost samples.
STAMPLESS_SCENES = {
    "0 % lost": Scene(drops=0.0),
    "0.2 % lost": Scene(drops=0.002),
    "2 % lost": Scene(drops=0.02),
}


def simulate(scene: Scene, *, seconds: float, seed: int) -> Take:
    """Simulate one take of a scene."""
    rng = np.random.default_rng(seed)
    sequence = np.arange(int(seconds * scene.rate_hz))
    sequence = sequence[rng.random(len(sequence)) >= scene.drops]
    device_s = sequence / scene.rate_hz
    true_s = _true_times(scene, device_s) + rng.random() * 1e-2
    if scene.stop_ms:
        parts = len(true_s) * np.arange(1, scene.num_stops + 1) // (scene.num_stops + 1)
        true_s += np.searchsorted(parts, np.arange(len(true_s)), "right") * scene.stop_ms * 1e-3
    arrival_s = _arrivals(scene, true_s, rng)
    middle_s = true_s[len(true_s) // 2]
    arrival_s, true_s = (
        t_s + np.clip((t_s - middle_s) / SLEW_S, 0, 1) * scene.slew_ms * 1e-3
        for t_s in (arrival_s, true_s)
    )
    step_s = true_s[len(true_s) // 2] if scene.step_ms else np.inf
    device_s = device_s + (true_s >= step_s) * scene.step_ms * 1e-3
    if scene.wrong_stamps:
        device_s = device_s + (rng.random(len(device_s)) < scene.wrong_stamps) * WRONG_S
    device_ns = np.rint(device_s * 1e9).astype(np.int64) + DEVICE_ORIGIN_NS
    host_ns, true_ns = (
        np.rint(t_s * 1e9).astype(np.int64) + HOST_ORIGIN_NS for t_s in (arrival_s, true_s)
    )
    step_ns = HOST_ORIGIN_NS + round(step_s * 1e9) if scene.step_ms else None
    ticks_ns = device_ns // scene.tick_ns * scene.tick_ns
    return Take(scene, sequence.astype(np.int64), ticks_ns, host_ns, true_ns, step_ns)


def _true_times(scene: Scene, device_s: np.ndarray) -> np.ndarray:
    turns = 2 * np.pi / WANDER_PERIOD_S
    wander_s = scene.wander_ppm * 1e-6 / turns * np.sin(turns * device_s)
    return np.asarray(device_s * (1 + scene.skew_ppm * 1e-6) + wander_s)


def _arrivals(scene: Scene, true_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    num = len(true_s)
    delay_s = BASE_DELAY_NS * 1e-9 + rng.exponential(scene.jitter_ms * 1e-3, num)
    waits = rng.random(num) < scene.outliers
    delay_s += waits * rng.exponential(scene.outlier_ms * 1e-3, num)
    num_late = min(num // 4, round(LATE_PATH_S * scene.rate_hz))
    delay_s[num // 2 : num // 2 + num_late] += scene.late_path_ms * 1e-3
    grid_s = scene.grid_ms * 1e-3
    # Packets keep their order: a late packet delays those behind it.
    return np.asarray(np.maximum.accumulate(np.ceil((true_s + delay_s) / grid_s) * grid_s))
