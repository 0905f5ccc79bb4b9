"""Clocks of devices as health judges them: skew, steps, and what a busy host must not feign."""

from dataclasses import replace

import numpy as np
import pytest

from dextouch.streams import StreamDescriptor
from services.acquisition.devices.tactile_glove import glove_descriptor
from services.acquisition.health.clock import ClockCheck, CountingCheck
from tests.unit.acquisition.health_blocks_made import SECOND_NS, block, codes, judged


def stamped(second, *, skew_ppm=0.0, step_ns=0, rng=None, delay_ms=0.0):
    t_s = second + np.arange(60) / 60
    numbers = second * 60 + np.arange(60)
    device_ns = np.rint(t_s * 1e9 * (1 - skew_ppm * 1e-6)).astype(np.int64) + 10**12 + step_ns
    delays_s = 0 if rng is None else rng.exponential(delay_ms * 1e-3, 60)
    return block(t_s + delays_s, t_device_ns=device_ns, sequence=numbers)


@pytest.mark.parametrize(("skew_ppm", "level"), [(50, None), (-400, "WARN"), (3000, "ERROR")])
def test_skew_is_found_within_two_seconds_and_later(skew_ppm, level, rng):
    judge = ClockCheck(glove_descriptor("left"))
    for second in range(15):
        arrived = stamped(second, skew_ppm=skew_ppm, rng=rng, delay_ms=0.5)
        verdict = judged(judge, arrived, (second + 1) * SECOND_NS)
        if second >= 1:
            assert codes(verdict).get("clock_skew") == level, second
    assert verdict.figures["clock_skew_ratio"] * 1e6 == pytest.approx(skew_ppm, abs=30)


def test_steps_are_counted_once_and_three_in_an_hour_are_an_error():
    judge = ClockCheck(glove_descriptor("left"))
    levels = []
    steps_ns = [0] * 4 + [-30_000_000] * 4 + [50_000_000] * 4 + [0] * 4
    for second, step_ns in enumerate(steps_ns):
        verdict = judged(judge, stamped(second, step_ns=step_ns), (second + 1) * SECOND_NS)
        levels.append(codes(verdict).get("clock_step"))
    assert levels == [None] * 4 + ["WARN"] * 8 + ["ERROR"] * 4
    assert judge.num_steps == 3
    quiet = judged(judge, block([]), 3700 * SECOND_NS)
    assert quiet.findings == []


def late_ms(load, t_s):
    """How long a host that is busy in some way makes samples wait."""
    if load == "at the start":
        return 60.0 * (t_s < 1.3)
    if load == "two seconds and a half":
        return 40.0 * ((t_s > 6) & (t_s < 8.5))
    return np.clip(20.0 * (t_s - 4), 0.0, 50.0) * (t_s < 9)


@pytest.mark.parametrize("load", ["at the start", "two seconds and a half", "a growing queue"])
@pytest.mark.parametrize("has_sequence", [True, False])
def test_late_arrivals_of_a_busy_host_are_no_finding_of_the_devices_clock(load, has_sequence, rng):
    descriptor = glove_descriptor("left")
    capabilities = descriptor.capabilities.model_copy(update={"sequence": has_sequence})
    judge = ClockCheck(descriptor.model_copy(update={"capabilities": capabilities}))
    raised = set()
    for second in range(15):
        arrived = stamped(second, skew_ppm=50.0, rng=rng, delay_ms=0.5)
        t_s = second + np.arange(60) / 60
        t_host_ns = arrived.t_host_ns + np.rint(late_ms(load, t_s) * 1e6).astype(np.int64)
        t_host_ns = np.maximum.accumulate(t_host_ns)
        sequence = arrived.sequence if has_sequence else np.full(60, -1)
        late = replace(arrived, t_host_ns=t_host_ns, sequence=sequence)
        raised |= set(codes(judged(judge, late, (second + 1) * SECOND_NS)))
    assert raised <= {"clock_residual"}


def test_a_clock_that_wraps_is_no_step():
    capabilities = glove_descriptor("left").capabilities.model_copy(
        update={"sequence_bits": 16, "device_time_bits": 32, "tick_ns": 1000}
    )
    descriptor = glove_descriptor("left").model_copy(update={"capabilities": capabilities})
    judge = ClockCheck(descriptor)
    modulus_ns = 2**32 * 1000
    for second in range(6):
        arrived = stamped(second)
        device_ns = (arrived.t_device_ns - 10**12 + modulus_ns - 3 * SECOND_NS) % modulus_ns
        numbers = (arrived.sequence + 2**16 - 100) % 2**16
        wrapped = replace(arrived, t_device_ns=device_ns, sequence=numbers)
        assert judged(judge, wrapped, (second + 1) * SECOND_NS).findings == []
    assert judge.num_steps == 0


def bare_descriptor(rate_hz=60):
    return StreamDescriptor(
        name="tactile_left",
        kind="tactile",
        shape=(400,),
        dtype="float32",
        unit="counts",
        nominal_rate_hz=rate_hz,
    )


def bare(numbers, rng, *, delay_ms, skew_ppm=0.0):
    t_s = numbers / 60 * (1 + skew_ppm * 1e-6) + rng.exponential(delay_ms * 1e-3, len(numbers))
    return block(np.maximum.accumulate(t_s))


@pytest.mark.parametrize(
    ("delay_ms", "level"), [(0.5, None), (2.0, "WARN"), (5.0, "ERROR")], ids=["0.5", "2", "5"]
)
def test_a_stream_without_stamps_is_judged_by_its_count(delay_ms, level, rng):
    judge = CountingCheck(bare_descriptor())
    for second in range(15):
        numbers = second * 60 + np.arange(60)
        kept = numbers[rng.random(60) > 0.005]
        arrived = bare(kept, rng, delay_ms=delay_ms, skew_ppm=300.0)
        verdict = judged(judge, arrived, (second + 1) * SECOND_NS)
    assert codes(verdict) == ({} if level is None else {"clock_residual": level})
    figures = verdict.figures
    if level is None:
        assert figures["clock_skew_ratio"] * 1e6 == pytest.approx(300, abs=60)
        assert figures["clock_residual_p95_seconds"] == pytest.approx(1.15e-3, abs=0.4e-3)
        assert figures["clock_resets"] == 0
    assert len(judge._undated) <= 10 * 6
    assert codes(judged(judge, block([]), 16 * SECOND_NS)) == {}


def test_a_restart_of_a_stream_without_stamps_is_counted_and_no_clock_is_guessed(rng):
    judge = CountingCheck(bare_descriptor())
    for second in range(20):
        # It pauses for half a second and goes on between two of its former moments.
        numbers = second * 60 + np.arange(60) + (30.5 if second >= 10 else 0.0)
        verdict = judged(judge, bare(numbers, rng, delay_ms=0.3), (second + 1) * SECOND_NS)
    assert verdict.figures["clock_resets"] == 1
    unsteady = CountingCheck(bare_descriptor())
    for second in range(5):
        arrived = block(second + np.sort(rng.random(40)))
        assert judged(unsteady, arrived, (second + 1) * SECOND_NS).figures == {}
