"""Devices on which several things go wrong in one take, with the true time of every sample.

A simulation of its own: it follows the device's oscillator and the packet's path event by event and
shares nothing with the package or with the scenes of the benchmark.
"""

from dataclasses import dataclass

import numpy as np

KINDS = ("stop", "step", "slew", "pause", "burst", "drop", "glitch")
ORIGIN_NS = 50_000 * 10**9


@dataclass(frozen=True)
class Event:
    """Something that happens `at_s` after the start.

    Sizes: stop (oscillator and samples stand), pause (no samples), burst (packets are held) and
    drop (packets are lost) last `size_s`; a step adds it to the device's clock; a slew adds it in
    `lasts_s`; a glitch adds it to one stamp.
    """

    kind: str
    at_s: float
    size_s: float
    lasts_s: float = 0.0


@dataclass(frozen=True)
class Mixture:
    """A drawn take.

    Attributes:
        events: in order of time.
        rate_hz: of the device.
        bits: of its counter, whose ticks are `tick_ns`; it starts `wraps_in_s` before its wrap.
        numbered: whether packets carry a number.
    """

    events: tuple[Event, ...]
    seed: int
    seconds: float = 60.0
    rate_hz: float = 60.0
    skew_ppm: float = 0.0
    jitter_ms: float = 0.5
    bits: int = 64
    tick_ns: int = 1
    wraps_in_s: float = 0.0
    numbered: bool = False


@dataclass(frozen=True)
class Recorded:
    """What arrives, and `true_ns`, when it left the device without the constant path delay."""

    true_ns: np.ndarray
    device_ns: np.ndarray
    host_ns: np.ndarray
    sequence: np.ndarray


def draw(rng):
    """A take of one to four events with at least eight seconds between them."""
    events, at_s = [], rng.uniform(6, 12)
    for _ in range(rng.integers(1, 5)):
        kind = str(rng.choice(KINDS))
        size_s = float(np.exp(rng.uniform(np.log(0.001), np.log(3.0))))
        if kind == "glitch":
            size_s = min(size_s, 0.5)
        lasts_s = 0.0
        if kind == "slew":
            # chrony's fastest is 83 333 ppm, ntpd's 500 ppm.
            rate = float(np.exp(rng.uniform(np.log(500e-6), np.log(83e-3))))
            size_s = min(size_s, 0.1)
            lasts_s = min(size_s / rate, 20.0)
        if kind in {"step", "slew", "glitch"}:
            size_s *= rng.choice([-1, 1])
        events.append(Event(kind, at_s, float(size_s), lasts_s))
        at_s += lasts_s + rng.uniform(8, 15)
    bits, tick_ns = [(64, 1), (32, 1000), (32, 125), (24, 10_000)][rng.integers(4)]
    return Mixture(
        tuple(events),
        seed=int(rng.integers(2**31)),
        seconds=at_s + float(rng.choice([0.0, 130.0])),
        rate_hz=float(rng.choice([30, 60, 100, 120])),
        skew_ppm=float(rng.uniform(-100, 100)),
        jitter_ms=float(rng.uniform(0.1, 1.0)),
        bits=bits,
        tick_ns=tick_ns,
        wraps_in_s=float(rng.uniform(3, 100)),
        numbered=bool(rng.integers(2)),
    )


def simulate(mixture):
    """Let it happen, sample by sample in order of the oscillator's ticks."""
    rng = np.random.default_rng(mixture.seed)
    ticks_s = np.arange(int(mixture.seconds * mixture.rate_hz)) / mixture.rate_hz
    true_s = ticks_s * (1 + mixture.skew_ppm * 1e-6) + rng.random() * 0.02
    stamp_s = ticks_s.copy()
    sent = np.ones(len(ticks_s), dtype=bool)
    lost = rng.random(len(ticks_s)) < rng.choice([0.0, 0.002])
    held = []
    for event in mixture.events:
        after = true_s >= event.at_s
        during = after & (true_s < event.at_s + event.size_s)
        if event.kind == "stop":
            true_s = true_s + after * event.size_s
        elif event.kind == "step":
            stamp_s = stamp_s + after * event.size_s
        elif event.kind == "slew":
            share = np.clip((true_s - event.at_s) / event.lasts_s, 0, 1)
            stamp_s = stamp_s + share * event.size_s
        elif event.kind == "pause":
            sent &= ~during
        elif event.kind == "drop":
            lost |= during
        elif event.kind == "burst":
            held.append((event.at_s, event.at_s + event.size_s))
        else:
            stamp_s[np.argmax(after)] += event.size_s
    sequence = np.cumsum(sent) - 1
    arrival_s = true_s + rng.exponential(mixture.jitter_ms * 1e-3, len(true_s))
    for from_s, to_s in held:
        waits = (arrival_s >= from_s) & (arrival_s < to_s)
        arrival_s[waits] = to_s
    kept = sent & ~lost
    # A packet that comes late delays those behind it.
    arrival_s = np.maximum.accumulate(arrival_s[kept])
    turn_ns = 2**mixture.bits * mixture.tick_ns
    start_ns = turn_ns - round(mixture.wraps_in_s * 1e9) if turn_ns < 2**62 else 10**12
    stamp_ns = np.rint(stamp_s[kept] * 1e9).astype(np.int64) + start_ns
    stamp_ns -= stamp_ns % mixture.tick_ns
    if turn_ns < 2**62:
        stamp_ns %= turn_ns
    true_ns, host_ns = (
        np.rint(t_s * 1e9).astype(np.int64) + ORIGIN_NS for t_s in (true_s[kept], arrival_s)
    )
    return Recorded(true_ns, stamp_ns, host_ns, sequence[kept])
