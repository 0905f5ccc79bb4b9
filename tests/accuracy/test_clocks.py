"""Clock fits against simulated truth: constant path delay removed, milliseconds of RMS error."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.clocks.benchmark import arrivals, ours_offline, ours_online, score
from benchmarks.clocks.scenes import (
    BASE_DELAY_NS,
    MORE_SCENES,
    SCENES,
    STAMPLESS_SCENES,
    Scene,
    simulate,
)
from dextouch.clocks import date_by_counting, fit_clock

SECONDS = 120.0
SEEDS = (0,)
COARSE = "stamps of 1 ms"


def tell(capsys, text):
    with capsys.disabled():
        sys.stdout.write(f"\n{text}")


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES | MORE_SCENES)
def test_error_against_truth(name, capsys):
    scene = find(name)
    online, offline, gains = [], [], []
    for seed in SEEDS:
        take = simulate(scene, seconds=SECONDS, seed=seed)
        estimate_ns = ours_online(take)
        assert (np.diff(estimate_ns) > 0).all()
        online.append(score(estimate_ns, take, is_online=True))
        offline.append(score(ours_offline(take), take, is_online=False))
        arrival = score(arrivals(take), take, is_online=False).rms_ms
        gains.append(arrival / offline[-1].rms_ms)
        if not scene.step_ms:
            gains.append(arrival / online[-1].rms_ms)
        model = fit_clock(take.t_device_ns, take.t_host_ns)
        assert model.num_steps == (scene.step_ms != 0)
        assert model.skew_ppm == pytest.approx(scene.skew_ppm, abs=10)
    bound_ms = 0.6 if name == COARSE else 0.3
    rms_ms, p99_ms, final_ms = (
        max(s.rms_ms for s in online),
        max(s.p99_ms for s in online),
        max(s.rms_ms for s in offline),
    )
    tell(
        capsys,
        f"{name:20s} online {rms_ms:6.3f} ms, p99 {p99_ms:6.3f} | offline {final_ms:6.3f} ms | "
        f"bound {bound_ms} ms | {min(gains):5.1f} times better than arrivals",
    )
    assert rms_ms <= bound_ms
    assert final_ms <= (0.4 if name == COARSE else bound_ms)
    if name != COARSE:
        assert p99_ms <= 1.0
        assert min(gains) >= 10
    assert all(s.recovery_s is None or s.recovery_s <= 1.2 for s in online)


@pytest.mark.long
def test_every_take_recovers_from_a_step(capsys):
    """Samples alone would not do: in some takes all those of the first 1.2 s wait too long."""
    recoveries_s, least_ms = [], []
    for seed in range(40):
        take = simulate(find("step -30 ms"), seconds=60.0, seed=seed)
        recoveries_s.append(score(ours_online(take), take, is_online=True).recovery_s)
        since_ns = take.true_ns - take.step_true_ns
        first = (since_ns >= 0) & (since_ns <= 1.2e9)
        waited_ns = take.t_host_ns[first] - take.true_ns[first] - BASE_DELAY_NS
        least_ms.append(waited_ns.min() * 1e-6)
    tell(
        capsys,
        f"40 steps of -30 ms   slowest recovery {max(recoveries_s):.2f} s, bound 1.2 s | in "
        f"{sum(ms > 0.3 for ms in least_ms)} takes no sample of 1.2 s waits less than 0.3 ms",
    )
    assert max(recoveries_s) <= 1.2
    assert max(least_ms) > 0.3


def find(name):
    return (SCENES | MORE_SCENES)[name]


@pytest.mark.long
@pytest.mark.parametrize("step_ms", [0.0, 200.0, -30.0, -9.0, -3.0])
@pytest.mark.parametrize("stall_s", [0.5, 2.5])
def test_stalls_are_no_steps(stall_s, step_ms):
    """Everything of a stall arrives at its end: late by seconds, and yet the clock did not jump."""
    take = simulate(Scene(step_ms=step_ms), seconds=SECONDS, seed=1)
    host_ns = take.t_host_ns.copy()
    for at_s in (15.0, 45.0):
        first_ns, last_ns = (host_ns[0] + int(1e9 * s) for s in (at_s, at_s + stall_s))
        host_ns[(host_ns > first_ns) & (host_ns < last_ns)] = last_ns
    stalled = dataclasses.replace(take, t_host_ns=host_ns)
    assert score(ours_online(stalled), stalled, is_online=True).rms_ms <= 0.3
    assert score(ours_offline(stalled), stalled, is_online=False).rms_ms <= 0.3
    assert fit_clock(stalled.t_device_ns, host_ns).num_steps == (step_ms != 0)


@pytest.mark.long
@pytest.mark.parametrize("name", STAMPLESS_SCENES)
def test_samples_without_stamps_are_counted(name, capsys):
    scene = STAMPLESS_SCENES[name]
    rms_ms, wrong = [], []
    for seed in range(3):
        take = simulate(scene, seconds=SECONDS, seed=seed)
        found = date_by_counting(take.t_host_ns, period_ns=round(1e9 / scene.rate_hz))
        rms_ms.append(score(found.t_host_ns, take, is_online=True).rms_ms)
        wrong.append(np.mean(np.diff(found.number) != np.diff(take.sequence)))
    tell(
        capsys,
        f"without stamps, {name:10s} {np.median(rms_ms):.3f} ms, bound 0.65 | wrong counts "
        f"{100 * max(wrong):.2f} %, bound 0.2",
    )
    assert np.median(rms_ms) <= 0.65
    assert max(wrong) <= 0.002


@pytest.mark.parametrize("rate_error", [0.01, -0.01])
def test_a_nominal_rate_may_be_wrong(rate_error):
    take = simulate(Scene(skew_ppm=rate_error * 1e6), seconds=SECONDS, seed=0)
    found = date_by_counting(take.t_host_ns, period_ns=round(1e9 / 60))
    assert score(found.t_host_ns, take, is_online=True).rms_ms <= 0.5
    assert found.skew_ppm == pytest.approx(rate_error * 1e6, abs=20)


SPEED_PROBE = """
import time
from dextouch.clocks import OnlineClock
clock = OnlineClock()
stamps = [(n * 16_666_667, n * 16_666_667 + (n * 7919) % 1000 * 3000) for n in range(20_000)]

def cpu_s(work):
    began = time.process_time()
    work()
    return time.process_time() - began

def update():
    for device, host in stamps[start : start + 4000]:
        clock.update(t_host_ns=host, t_device_ns=device)

def plain_steps():
    seen = {}
    for n in range(40_000):
        seen[n % 7] = max(seen.get(n % 7, 0), n) - 1

times = []
for start in range(0, 20_000, 4000):
    times.append((cpu_s(update) / 4000, cpu_s(plain_steps) / 40_000))
update_s, step_s = map(min, zip(*times))
print(update_s * 1e6, update_s / step_s)
"""
DAY_PROBE = """
import json, resource, sys
import numpy as np
from dextouch.clocks import OnlineClock
from dextouch.streams.samples import ClockCapabilities, StreamDescriptor
kind, rate_hz, hours = sys.argv[1], 1, 24
capabilities = {
    "u16 sequence": ClockCapabilities(sequence=True, sequence_bits=16),
    "u32 us": ClockCapabilities(device_time=True, device_time_bits=32, tick_ns=1000),
}[kind]
descriptor = StreamDescriptor(name="d", kind="scalar", shape=(1,), dtype="float32", unit="1",
                              nominal_rate_hz=rate_hz, capabilities=capabilities)
clock, rng = OnlineClock(descriptor), np.random.default_rng(0)
num, errors, peaks, wraps = 3600 * rate_hz, [], [], 0
for hour in range(hours):
    n = np.arange(hour * num, (hour + 1) * num)
    device_ns = n * (10**9 // rate_hz) + 3_000_000_000
    true_ns = device_ns + np.rint(device_ns * 50e-6).astype(np.int64) + 10**18
    host_ns = true_ns + 2_000_000 + rng.exponential(0.8e6, num).astype(np.int64)
    before = None
    for number, device, host, true in zip(*(a.tolist() for a in (n, device_ns, host_ns, true_ns))):
        if kind == "u16 sequence":
            raw = number % 2**16
            got = clock.update(t_host_ns=host, sequence=raw)
        else:
            raw = device // 1000 % 2**32
            got = clock.update(t_host_ns=host, t_device_ns=raw * 1000)
        wraps += before is not None and raw < before
        before = raw
        if hour or number > 60 * rate_hz:
            errors.append(got - true - 2_000_000)
    peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    spread = float(np.sqrt(np.mean(np.square(errors)))) * 1e-6
    worst = max(map(abs, errors)) * 1e-6
    errors = []
    if hour == 0:
        rms_ms, worst_ms = spread, worst
    rms_ms, worst_ms = max(rms_ms, spread), max(worst_ms, worst)
print(json.dumps({"rms_ms": rms_ms, "worst_ms": worst_ms, "wraps": wraps,
                  "steps": clock.num_steps, "grown_kb": peaks[-1] - peaks[1]}))
"""


def probe(code, *words):
    """In a process of its own: the shape checks of the tests would cost more than the clock."""
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout


@pytest.mark.long
def test_online_clock_costs_microseconds(capsys):
    # Beside a loop of plain Python, so that a slow or busy machine slows both: 20 us where a step
    # of the loop takes 0.27 us.
    cost_us, steps = map(float, probe(SPEED_PROBE).split())
    tell(capsys, f"online clock {cost_us:.1f} us a sample, {steps:.0f} plain steps | bound 80")
    assert steps <= 80


@pytest.mark.parametrize(("kind", "min_wraps"), [("u16 sequence", 1), ("u32 us", 20)])
@pytest.mark.slow
def test_a_day_of_wrapping_counters(kind, min_wraps, capsys):
    found = json.loads(probe(DAY_PROBE, kind))
    tell(
        capsys,
        f"24 h, {kind:13s} {found['wraps']} wraps | worst hour {found['rms_ms']:.3f} ms, bound 0.3"
        f" | worst sample {found['worst_ms']:.2f} ms | memory +{found['grown_kb']} kB, bound 1000",
    )
    assert found["wraps"] >= min_wraps
    assert found["rms_ms"] <= 0.3
    assert found["worst_ms"] <= 3.0
    assert found["steps"] == 0
    assert found["grown_kb"] <= 1000
