"""Teleoperation with faults of samples, delivery and loop: every command keeps every limit.

A minute of it by default, an hour with `make slow`, in virtual time.
"""

import sys
from collections import Counter
from itertools import combinations

import numpy as np
import pytest

from benchmarks.simulated.hand_motions import Motion, _capsules, fuzzed, segment_distance_m
from services.pipelines.teleoperation.hand_follower import HandFollower, HandSample
from services.pipelines.teleoperation.settings import CommandLimits
from services.twin.hands import HumanHand, twin_hand

SAMPLE_HZ = 60
SPEED_RAD_S = 9.6
CLEAN_SAMPLES = 240


def human_samples(num_samples, rng):
    """Keypoints of a person whose fingers also run through each other, with faults of all kinds."""
    hand = HumanHand("right")
    t_s = np.arange(num_samples) / SAMPLE_HZ
    middle, half = 0.5 * (hand.lower_rad + hand.upper_rad), 0.5 * (hand.upper_rad - hand.lower_rad)
    rates_hz, phases = rng.uniform(0.1, 1.2, (2, 20)), rng.uniform(0, 2 * np.pi, (2, 20))
    waves = np.sin(2 * np.pi * rates_hz[:, None] * t_s[:, None] + phases[:, None]).mean(axis=0)
    # Jumps: the tracker takes another posture for some time.
    jumps = np.repeat(rng.random(-(-num_samples // 40)) < 0.15, 40)[:num_samples]
    waves[jumps] = np.roll(waves, num_samples // 2, axis=0)[jumps]
    joints = middle + half * waves
    keypoints_m = hand.keypoints_m(joints)
    keypoints_m += rng.normal(0, 5e-4, keypoints_m.shape)
    tips_m = hand.fingertips_m(joints)
    faulty = fuzzed(Motion("right", joints, keypoints_m, tips_m), rng).keypoints_m
    # Those that are checked at the start are clean.
    faulty[:CLEAN_SAMPLES] = keypoints_m[:CLEAN_SAMPLES]
    return faulty


def delivered(num_samples, rng):
    """Time of arrival and index of samples, some lost, twice, out of order, or late in a burst."""
    sent_s = np.arange(num_samples) / SAMPLE_HZ
    arrival_s = sent_s + rng.exponential(0.002, num_samples)
    at = CLEAN_SAMPLES
    while at < num_samples:
        length = int(rng.choice([6, 30, 120, 600], p=[0.5, 0.3, 0.15, 0.05]))
        fault = rng.integers(3)
        stop = min(at + length, num_samples)
        if fault == 0:
            arrival_s[at:stop] = arrival_s[stop - 1]
        elif fault == 1:
            arrival_s[at:stop] = np.inf
        else:
            arrival_s[at:stop] += rng.uniform(0, 0.05, stop - at)
        at = stop + int(rng.integers(20, 300))
    again = np.flatnonzero(rng.random(num_samples) < 0.01)
    index = np.concatenate([np.arange(num_samples), again])
    t_s = np.concatenate([arrival_s, arrival_s[again] + 0.001])
    order = np.argsort(t_s, kind="stable")
    return t_s[order], index[order]


def due_times(duration_s, rate_hz, rng):
    """Times of the commands: as the loop of the service, which is late now and then."""
    times, due_s = [], 0.0
    while due_s < duration_s:
        late_s = rng.exponential(0.0005) + (rng.random() < 0.003) * rng.uniform(0, 0.4)
        times.append(due_s + late_s)
        due_s += 1 / rate_hz + (late_s if late_s > 1 / rate_hz else 0.0)
    return np.maximum.accumulate(times)


def gaps_m(joints_rad):
    """Smallest gap between two fingers, by the benchmark's own geometry."""
    starts, ends, radii = _capsules(twin_hand("right", "robot"), joints_rad)
    least_m = np.full(len(starts), np.inf)
    for a, b in combinations(range(5), 2):
        p, q = np.divmod(np.arange(9), 3)
        found_m = segment_distance_m(starts[:, a, p], ends[:, a, p], starts[:, b, q], ends[:, b, q])
        least_m = np.minimum(least_m, (found_m - radii[a, p] - radii[b, q]).min(axis=1))
    return least_m


@pytest.mark.parametrize(
    ("duration_s", "rate_hz"),
    [
        pytest.param(60, 200.0, marks=pytest.mark.long),
        pytest.param(3600, 60.0, marks=pytest.mark.slow),
    ],
)
def test_every_command_keeps_every_limit(duration_s, rate_hz, capsys):
    rng = np.random.default_rng(duration_s)
    num_samples = duration_s * SAMPLE_HZ
    keypoints_m = human_samples(num_samples, rng)
    arrival_s, index = delivered(num_samples, rng)
    follower = HandFollower("right", CommandLimits(relax_after_s=1.0), rate_hz, {})
    times_s, commands, at = due_times(duration_s, rate_hz, rng), [], 0
    for t_s in times_s:
        while at < len(arrival_s) and arrival_s[at] <= t_s:
            stamp = 10**18 + round(int(index[at]) * 1e9 / SAMPLE_HZ)
            follower.receive(HandSample(keypoints_m[index[at]], stamp), float(arrival_s[at]))
            if follower.can_check:
                follower.check_person()
            at += 1
        commands.append(follower.command(float(t_s)))
    joints = np.stack([command.joints_rad for command in commands])
    statuses = Counter(command.status.value for command in commands)
    steps_rad = np.abs(np.diff(joints, axis=0)).max(axis=1)
    reach_rad = SPEED_RAD_S * np.minimum(np.diff(times_s), 1 / rate_hz)
    least_m = np.concatenate([gaps_m(part) for part in np.array_split(joints, 100)])
    num_stopped = sum(bool(command.stopped_fingers) for command in commands)
    with capsys.disabled():
        sys.stdout.write(
            f"\n{duration_s} s at {rate_hz:g} Hz: {dict(statuses)} | refused "
            f"{dict(follower.refused)} | largest step {steps_rad.max():.4f} rad of "
            f"{SPEED_RAD_S / rate_hz:.4f} | smallest gap {1e3 * least_m.min():.4f} mm, fingers "
            f"stopped in {num_stopped} commands\n"
        )
    assert np.isfinite(joints).all()
    assert (steps_rad <= reach_rad + 1e-9).all()
    assert (joints >= follower.hand.lower_rad).all()
    assert (joints <= follower.hand.upper_rad).all()
    assert least_m.min() > -1e-9
    # All of it happened.
    assert set(statuses) >= {"not_ready", "following", "holding", "relaxing"}
    assert statuses["following"] > 0.3 * len(commands)
    assert set(follower.refused) >= {"time", "late", "missing", "implausible"}
    assert steps_rad.max() > 0.99 * SPEED_RAD_S / rate_hz
    assert num_stopped > 0.01 * len(commands)
