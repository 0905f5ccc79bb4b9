"""A hand that follows samples: watchdog, limits and refused samples, in virtual time."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from benchmarks.simulated.hand_motions import robot_motion
from dextouch.errors import InvalidInputError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.robot_hand import RobotHand
from services.pipelines.teleoperation.hand_follower import HandFollower, HandSample
from services.pipelines.teleoperation.settings import CommandLimits
from tests.unit.teleoperation.hands import RATE_HZ, SIDE, Run, lost, motion, sample

HAND = RobotHand(SIDE)
STEP_RAD = 9.6 / RATE_HZ


def statuses(commands):
    """Each status, once where it lasts."""
    found = [command.status.value for command in commands]
    return [one for one, before in zip(found, [None, *found], strict=False) if one != before]


@pytest.fixture
def run():
    """A run that has followed for a second."""
    started = Run()
    started.play(3.0)
    return started


def test_the_hand_holds_while_the_first_samples_are_checked_and_then_follows():
    run = Run()
    commands = run.play(5.0)
    assert statuses(commands) == ["not_ready", "following"]
    began = next(c.step for c in commands if c.status == "following")
    assert began == pytest.approx(120 / 60 * RATE_HZ, abs=5)
    assert (run.joints_rad()[:began] == 0).all()
    true_rad = motion().joints_rad
    errors_deg = [
        np.rad2deg(np.abs(c.joints_rad - true_rad[(c.t_device_ns - 10**15) * 60 // 10**9]).max())
        for c in commands[began + 200 :]
    ]
    # 0.1 mm of noise, and the way of one sample's time.
    assert np.median(errors_deg) < 3
    assert {c.received_s for c in commands if c.step < began} == {None}
    assert sum(c.received_s is not None for c in commands) == pytest.approx(180, abs=3)


def test_without_samples_it_holds_then_relaxes_slowly_and_comes_back_at_the_speed_limit(run):
    before = run.commands[-1].joints_rad
    commands = run.play(20.0, lost)
    assert statuses(commands) == ["following", "holding", "relaxing"]
    held = [c for c in commands if c.status == "holding"]
    assert held[0].age_s == pytest.approx(0.1, abs=0.006)
    assert held[-1].age_s == pytest.approx(5.0, abs=0.006)
    assert all((c.joints_rad == held[0].joints_rad).all() for c in held)
    assert np.abs(held[0].joints_rad - before).max() < 0.5
    relaxed = np.stack([c.joints_rad for c in commands if c.status == "relaxing"])
    assert np.abs(np.diff(relaxed, axis=0)).max() == pytest.approx(0.5 / RATE_HZ, rel=1e-6)
    np.testing.assert_allclose(relaxed[-1], np.clip(0.0, HAND.lower_rad, HAND.upper_rad))
    back = run.play(2.0)
    assert statuses(back) == ["relaxing", "following"]
    steps = np.abs(np.diff([c.joints_rad for c in back], axis=0)).max(axis=1)
    assert steps.max() == pytest.approx(STEP_RAD, rel=1e-6)
    assert back[-1].lag_rad < 0.2


def test_no_command_goes_further_for_being_late_or_early(run):
    far = run.commands[-1].joints_rad
    run.play(20.0, lost)
    follower, t_s = run.follower, run.t_s
    before = run.commands[-1].joints_rad
    elapsed_s = [1 / RATE_HZ, 0.5, 0.0, 0.001, 1 / RATE_HZ, 3.0, 1e-6]
    for number, late_s in enumerate(elapsed_s):
        t_s += late_s
        # The same hand again, with stamps of now.
        given = sample(150 + number)
        given = replace(given, t_device_ns=10**15 + round((t_s - 1000.0) * 1e9))
        follower.receive(given, t_s)
        after = follower.command(t_s).joints_rad
        assert np.abs(after - before).max() <= 9.6 * min(late_s, 1 / RATE_HZ) + 1e-10
        before = after
    assert np.abs(far - before).max() > 0.01


def refused_by(run, given):
    before = run.follower.refused.copy()
    run.follower.receive(given, run.t_s)
    return dict(run.follower.refused - before)


def test_samples_that_say_nothing_new_are_refused_and_do_not_calm_the_watchdog(run):
    last = sample(run.index - 1)
    now_ns = 10**15 + round((run.t_s - 1000.0) * 1e9)
    nothing = np.full((25, 3), np.nan)
    assert refused_by(run, last) == {"time": 1}
    assert refused_by(run, replace(last, t_device_ns=last.t_device_ns - 5)) == {"time": 1}
    assert refused_by(run, replace(last, t_device_ns=now_ns + 3 * 10**9)) == {"time": 1}
    assert refused_by(run, replace(last, t_device_ns=now_ns)) == {"repeated": 1}
    assert refused_by(run, HandSample(nothing, now_ns + 1)) == {"missing": 1}
    run.t_s += 0.3
    # It was sent 0.3 s ago.
    assert refused_by(run, replace(sample(run.index + 1), t_device_ns=now_ns + 2)) == {"late": 1}
    assert run.follower.command(run.t_s).status == "holding"


@pytest.mark.parametrize(
    "change",
    [
        lambda index: None if index % 2 else sample(index),
        lambda index: replace(sample(200), t_device_ns=sample(index).t_device_ns),
        lambda index: replace(sample(index), keypoints_m=sample(index).keypoints_m * 1000),
        lambda index: replace(sample(index), keypoints_m=sample(index).keypoints_m * 2),
        lambda index: HandSample(np.full((25, 3), np.nan), sample(index).t_device_ns),
    ],
    ids=["every other is lost", "frozen", "millimetres", "twice as large", "unseen"],
)
def test_what_is_no_fresh_sample_of_this_hand_leads_to_a_hold(run, change, request):
    commands = run.play(1.0, change)
    is_half = "every other" in request.node.callspec.id
    assert statuses(commands) == (["following"] if is_half else ["following", "holding"])
    assert not np.isnan(run.joints_rad()).any()


def test_the_time_of_samples_that_do_not_fit_is_counted_once(run, monkeypatch):
    """Else a finger is taken for lost, and searched anew, after 50 instead of 100 ms."""
    first, elapsed_s, retargeter = run.index, [], run.follower._retargeter
    step = retargeter.step

    def counted(keypoints_m, since_s):
        elapsed_s.append(since_s)
        return step(keypoints_m, since_s)

    def large(index):
        given = sample(index)
        return replace(given, keypoints_m=given.keypoints_m * (2 if index < first + 3 else 1))

    monkeypatch.setattr(retargeter, "step", counted)
    run.play(0.1, large)
    assert run.follower.refused["implausible"] == 3
    assert elapsed_s == pytest.approx([1 / 60] * 6)


def test_a_burst_after_a_stall_is_followed_from_its_newest_sample(run):
    first = run.index
    run.play(0.5, lost)
    for index in range(first, run.index + 1):
        run.follower.receive(sample(index), run.t_s)
    command = run.follower.command(run.t_s)
    assert command.status == "following"
    assert command.t_device_ns == sample(run.index).t_device_ns
    # All but those of the last 0.1 s.
    assert run.follower.refused["late"] == pytest.approx(0.4 * 60, abs=2)


def test_a_tracker_whose_clock_runs_slowly_is_followed_for_an_hour():
    follower = HandFollower(SIDE, CommandLimits(), RATE_HZ, {})
    for second in range(3600):
        # 50 parts in a million: 0.18 s in the end.
        stamp = round(second * 1e9 * (1 - 50e-6))
        follower.receive(HandSample(sample(second).keypoints_m, stamp), 5.0 + second)
    assert not follower.refused


@pytest.mark.parametrize("off_s", [-10, 10])
def test_a_first_sample_of_another_time_delays_nothing(off_s):
    follower = HandFollower(SIDE, CommandLimits(), RATE_HZ, {})
    for index in range(122):
        t_device_ns = sample(index).t_device_ns + (0 if index else off_s * 10**9)
        follower.receive(HandSample(sample(index).keypoints_m, t_device_ns), 5.0 + index / 60)
    assert follower.refused == {"time": 1}
    assert follower.can_check


def test_a_stop_holds_until_the_next_start(run):
    run.follower.stop()
    held = run.play(10.0)
    assert statuses(held) == ["stopped"]
    assert all((c.joints_rad == held[0].joints_rad).all() for c in held)
    start = held[0].joints_rad * 0.9
    run.follower.start(start)
    commands = run.play(3.0)
    assert statuses(commands) == ["not_ready", "following"]
    np.testing.assert_array_equal(commands[0].joints_rad, start)


def test_joints_keep_their_margin():
    wide = robot_motion(SIDE, 600, 2, natural=False).keypoints_m
    run = Run(margin_rad=0.2)
    run.play(8.0, lambda index: replace(sample(index), keypoints_m=wide[index]))
    joints = run.joints_rad()
    assert (joints >= HAND.lower_rad + 0.2).all()
    assert (joints <= HAND.upper_rad - 0.2).all()
    assert max(c.at_limits for c in run.commands) >= 0.05


@pytest.mark.parametrize(
    ("joints", "error"),
    [
        (np.zeros(19), "expected 20 finite angles"),
        (np.full(20, np.nan), "expected 20 finite angles"),
        (HAND.upper_rad + 0.1, "joint r_thumb_cmc_flex: got 1.391 rad, expected"),
    ],
)
def test_a_start_that_cannot_be_is_refused(run, joints, error):
    with pytest.raises(InvalidInputError, match=error):
        run.follower.start(joints)


def test_a_start_a_little_beyond_a_limit_begins_at_the_limit(run):
    run.follower.start(HAND.upper_rad + 0.01)
    command = run.play(0.01)[0]
    np.testing.assert_array_equal(command.joints_rad, HAND.upper_rad)
    assert command.at_limits == 1.0


def test_another_hand_is_refused_and_the_next_samples_are_checked():
    run = Run()
    mirror = np.array([1.0, -1.0, 1.0])
    with pytest.raises(InvalidInputError, match="got a left hand"):
        run.play(
            5.0,
            lambda index: replace(sample(index), keypoints_m=sample(index).keypoints_m * mirror),
        )
    assert statuses(run.play(4.0))[-1] == "following"


def test_keypoints_in_other_axes_are_turned_as_the_calibration_says():
    R = rotation_from_vector(np.array([0.3, -1.0, 0.5]))
    matrix = tuple(map(tuple, transform(R, np.zeros(3)).tolist()))

    def turned(index):
        given = sample(index)
        return replace(given, keypoints_m=given.keypoints_m @ R.T)

    straight, run = (
        Run(),
        Run(calibration={"T_keypoints_right_wrist_right": matrix}),
    )
    straight.play(4.0)
    run.play(4.0, turned)
    np.testing.assert_allclose(run.joints_rad(), straight.joints_rad(), atol=1e-3)


def test_a_finger_that_is_not_seen_stays_where_it_is(run):
    def without_index(index):
        keypoints_m = sample(index).keypoints_m.copy()
        keypoints_m[5:10] = np.nan
        return replace(sample(index), keypoints_m=keypoints_m)

    run.play(0.1, without_index)
    commands = run.play(1.0, without_index)
    assert statuses(commands) == ["following"]
    joints = np.stack([c.joints_rad for c in commands])
    assert np.ptp(joints[:, 4:8], axis=0).max() == 0
    assert np.ptp(joints[:, 8:12], axis=0).max() > 0.05
    assert commands[-1].finger_status[1].name == "MISSING"
    # Relaxed meanwhile, it stays relaxed.
    run.play(20.0, lost)
    again = run.play(0.5, without_index)
    assert np.abs(again[-1].joints_rad[4:8]).max() < 1e-9


def test_times_of_the_watchdog_are_in_order():
    with pytest.raises(ValidationError, match="relax_after_s: got"):
        CommandLimits(hold_after_s=0.1, relax_after_s=0.05)
