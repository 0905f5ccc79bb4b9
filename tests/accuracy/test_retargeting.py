"""Retargeting against forward kinematics of known joint angles, both hands."""

import sys
import time

import numpy as np
import pytest

from benchmarks.retargeting.compare import score_pinches
from benchmarks.simulated.hand_motions import pinch_motions, with_noise
from dextouch.hands import CHAINS, NODE_INDEX, NUM_KEYPOINTS, solver_indices
from dextouch.hands.robot_hand import RobotHand
from services.alignment.retargeting import HandRetargeter, RetargetOptions, RetargetStatus
from services.twin.hands import HumanHand

SIDES = ("left", "right")
EXACT = RetargetOptions(temporal_weight_m2=0.0)


def moving_joints(hand, num_steps, seed, *, natural):
    """Smooth joint angles: every joint its own sum of sines, inside the limits."""
    rng = np.random.default_rng(seed)
    low, high = hand.lower_rad.copy(), hand.upper_rad.copy()
    if natural:
        flexion = np.tile([True, False, True, True], 5)
        low, high = (
            np.where(flexion, 0.05 * high, 0.4 * low),
            np.where(flexion, 0.85 * high, 0.4 * high),
        )
    t_s = np.arange(num_steps)[:, None, None] / 60
    rate_hz = rng.uniform(0.15, 1.6, (20, 3))
    waves = np.sin(2 * np.pi * (rate_hz * t_s + rng.random((20, 3)))).mean(axis=-1)
    return low + (high - low) * (0.5 + 0.5 * waves)


def keypoints_of(hand, joints_rad):
    """The 25 human nodes of a hand with that skeleton."""
    points = hand.chain_points_m(joints_rad)
    keypoints = np.zeros((len(joints_rad), NUM_KEYPOINTS, 3))
    for finger, chain in enumerate(CHAINS):
        keypoints[:, solver_indices(chain)] = points[:, finger]
        if chain != "thumb":
            keypoints[:, NODE_INDEX[chain, "metacarpal"]] = 0.4 * points[:, finger, 0]
    return keypoints


def tip_error_mm(hand, got_rad, true_rad):
    reached, wanted = hand.fingertips_m(got_rad), hand.fingertips_m(true_rad)
    return np.linalg.norm(reached - wanted, axis=-1) * 1e3


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("natural", [True, False])
def test_robot_motion_is_recovered(side, natural, capsys):
    hand = RobotHand(side)
    joints = moving_joints(hand, 200, 1, natural=natural)
    retargeter = HandRetargeter(side, options=EXACT)
    began = time.perf_counter()
    result = retargeter.retarget(keypoints_of(hand, joints))
    step_us = (time.perf_counter() - began) / len(joints) * 1e6
    tip_mm = tip_error_mm(hand, result.joints_rad, joints)
    joint_deg = np.rad2deg(np.abs(result.joints_rad - joints))
    with capsys.disabled():
        sys.stdout.write(
            f"\n{side:5s} {'natural' if natural else 'full':7s} {step_us:4.0f} us a step | "
            f"tip max {tip_mm.max():.1e} mm, bound 1e-3 | "
            f"joint max {joint_deg.max():.1e} deg, bound 0.01"
        )
    assert (result.status == RetargetStatus.SOLVED).all()
    assert tip_mm.max() <= 1e-3
    assert joint_deg.max() <= 0.01
    assert result.tip_error_m.max() <= 1e-6


@pytest.mark.long
@pytest.mark.parametrize(("num_starts", "share"), [(1, 0.999), (8, 1.0)])
def test_cold_poses_anywhere_are_found(num_starts, share, capsys):
    hand = RobotHand("right")
    rng = np.random.default_rng(3)
    keypoints = keypoints_of(hand, rng.uniform(hand.lower_rad, hand.upper_rad, (5000, 20)))
    options = RetargetOptions(temporal_weight_m2=0.0, num_starts=num_starts)
    profile = HandRetargeter("right").measure(keypoints[:200])
    retargeter = HandRetargeter("right", profile, options)
    errors_m = np.empty((len(keypoints), 5))
    for index, sample in enumerate(keypoints):
        retargeter.reset()
        errors_m[index] = retargeter.step(sample).tip_error_m
    found = (errors_m < 1e-4).mean()
    with capsys.disabled():
        sys.stdout.write(f"\ncold, {num_starts} starts: {found:.4%} of fingers | bound {share:.1%}")
    assert found >= share


def test_one_millimetre_of_noise(capsys):
    hand = RobotHand("left")
    joints = moving_joints(hand, 200, 2, natural=True)
    keypoints = keypoints_of(hand, joints)
    keypoints += np.random.default_rng(5).normal(scale=1e-3, size=keypoints.shape)
    began = time.perf_counter()
    result = HandRetargeter("left").retarget(keypoints)
    step_us = (time.perf_counter() - began) / len(joints) * 1e6
    tip_mm = tip_error_mm(hand, result.joints_rad, joints)
    joint_deg = np.rad2deg(np.abs(result.joints_rad - joints))
    with capsys.disabled():
        sys.stdout.write(
            f"\n1 mm noise: {step_us:.0f} us a step | tip mean {tip_mm.mean():.2f} mm, bound 1.3 | "
            f"joint mean {joint_deg.mean():.2f} deg, bound 1.7"
        )
    assert (result.joints_rad >= hand.lower_rad).all()
    assert (result.joints_rad <= hand.upper_rad).all()
    assert tip_mm.mean() <= 1.3
    assert joint_deg.mean() <= 1.7


@pytest.mark.parametrize("side", SIDES)
def test_human_hand_keeps_its_angles(side, capsys):
    human, robot = HumanHand(side), RobotHand(side)
    joints = moving_joints(human, 200, 4, natural=True)
    result = HandRetargeter(side).retarget(keypoints_of(human, joints))
    angle_deg = np.rad2deg(np.abs(result.joints_rad - joints))
    with capsys.disabled():
        sys.stdout.write(
            f"\n{side} human hand: same-angle mean {angle_deg.mean():.2f} deg, bound 5 | "
            f"tip against target max {result.tip_error_m.max() * 1e3:.3f} mm"
        )
    assert (result.status == RetargetStatus.SOLVED).all()
    assert (result.joints_rad >= robot.lower_rad).all()
    assert (result.joints_rad <= robot.upper_rad).all()
    assert angle_deg.mean() <= 5


@pytest.mark.long
@pytest.mark.parametrize(("noise_m", "gap_mm"), [(0.0, 0.6), (1e-3, 2.0)])
@pytest.mark.parametrize("is_live", [False, True])
def test_pinches_close(noise_m, gap_mm, is_live, capsys):
    """Gap of the robot's tips where a person's are within 3 mm; with noise 2.3 mm unsmoothed."""
    rng = np.random.default_rng(5)
    people = [with_noise(one, noise_m, rng) for one in pinch_motions("right", 0)]
    answers = []
    for one in people:
        retargeter = HandRetargeter("right")
        if is_live:
            steps = [retargeter.step(sample).joints_rad for sample in one.keypoints_m]
            answers.append(np.concatenate(steps))
        else:
            answers.append(retargeter.retarget(one.keypoints_m).joints_rad)
    score = score_pinches(people, answers)
    with capsys.disabled():
        sys.stdout.write(
            f"\npinches, {'live' if is_live else 'batch'}, {noise_m * 1e3:g} mm of noise: gap mean "
            f"{score.gap_mean_mm:.2f} mm, bound {gap_mm} | off the person's joints "
            f"{score.same_angle_deg:.2f} deg, bound 3 | step {score.max_step_deg:.2f} deg"
        )
    assert score.gap_mean_mm <= gap_mm
    assert score.same_angle_deg <= 3
    assert score.num_outside == 0
    # 9.6 rad/s at 60 Hz.
    assert score.max_step_deg <= np.rad2deg(0.16) + 1e-6
