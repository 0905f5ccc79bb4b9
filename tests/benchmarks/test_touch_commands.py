"""Touching fingertips go to the human's places, and commands lead by the force that was felt."""

import numpy as np
import pytest

from benchmarks.closure.benchmark import (
    HandServos,
    commands_from_touch,
    pressing_forces_n,
)
from dextouch.errors import InvalidInputError, NonFiniteError
from dextouch.geometry import invert, transform
from dextouch.hands.robot_hand import RobotHand
from services.alignment.retargeting import wrist
from services.alignment.retargeting.wrist import (
    MatchedPoints,
    anchored_joints,
    fingertip_jacobians,
    robot_places_m,
    touch_shares,
)

SIDES = ("left", "right")
SERVOS = HandServos(finger_nm_rad=1.2, wrist_n_m=700.0, wrist_nm_rad=15.0)
NUM = 6
# A half-closed hand with the thumb in front of the fingers.
CLOSED = np.tile(np.array([0.5, 0.0, 0.5, 0.3]), 5)
CLOSED[:4] = [0.0, -0.5, 0.3, 0.3]
FINGER_JOINTS = [slice(4 * finger, 4 * finger + 4) for finger in range(5)]


def poses():
    return transform(np.tile(np.eye(3), (NUM, 1, 1)), np.arange(3.0 * NUM).reshape(NUM, 3) * 0.01)


@pytest.mark.parametrize("side", SIDES)
def test_jacobian_is_the_derivative(side):
    hand, step = RobotHand(side), 1e-6
    tips, jacobian = fingertip_jacobians(hand, CLOSED[None])
    for joint in range(20):
        moved = CLOSED.copy()
        moved[joint] += step
        rate = (hand.fingertips_m(moved[None]) - tips)[0, joint // 4] / step
        np.testing.assert_allclose(jacobian[0, joint // 4, :, joint % 4], rate, atol=1e-6)


@pytest.mark.parametrize("side", SIDES)
def test_touching_fingertips_go_where_the_humans_were(side, monkeypatch):
    hand = RobotHand(side)
    joints = np.tile(CLOSED, (NUM, 1))
    robot = robot_places_m(joints, hand)
    turns = np.random.default_rng(1).normal(scale=0.08, size=joints.shape)
    offset = np.tile([0.002, -0.003, 0.004], (NUM, 1))
    # Places that the robot can reach, a centimetre or so away.
    human = robot_places_m(joints + turns, hand) + offset[:, None]
    points = MatchedPoints(human, robot, np.ones((NUM, 6), dtype=bool))
    shares = np.tile([1.0, 0.5, 1.0, 0.0, 0.0], (NUM, 1))
    monkeypatch.setattr(wrist, "STAY_M2_RAD2", 1e-9)
    led = anchored_joints(hand, joints, points, offset, shares)
    assert (led >= hand.lower_rad).all()
    assert (led <= hand.upper_rad).all()
    reached = hand.fingertips_m(led)
    wanted = robot[:, :5] + shares[..., None] * (human - robot - offset[:, None])[:, :5]
    for finger in (0, 1, 2):
        np.testing.assert_allclose(reached[:, finger], wanted[:, finger], atol=2e-4)
    # Free fingers keep their angles to the last bit.
    for finger in (3, 4):
        np.testing.assert_array_equal(
            led[:, FINGER_JOINTS[finger]], joints[:, FINGER_JOINTS[finger]]
        )


def test_fingertips_that_were_not_seen_are_left_alone():
    hand, joints = RobotHand("right"), np.tile(CLOSED, (NUM, 1))
    robot = robot_places_m(joints, hand)
    points = MatchedPoints(robot + 0.01, robot, np.zeros((NUM, 6), dtype=bool))
    led = anchored_joints(hand, joints, points, np.zeros((NUM, 3)), np.ones((NUM, 5)))
    np.testing.assert_array_equal(led, joints)


def test_shares_rise_before_touch_and_fall_after():
    forces = np.zeros((61, 6))
    forces[30, 1] = 5.0
    shares = touch_shares(forces, np.arange(61) / 15)
    assert (shares[:, [0, 2, 3, 4]] == 0).all()
    assert shares[30, 1] == pytest.approx(5.0 / 5.1)
    assert (np.diff(shares[:31, 1]) > 0).all()
    np.testing.assert_allclose(shares[:, 1], shares[::-1, 1], atol=1e-12)
    decayed = 5.0 * np.exp(-(10 / 15) / 0.3)
    assert shares[20, 1] == pytest.approx(decayed / (decayed + 0.1))


def test_shares_are_within_bounds_for_any_force():
    forces, times = np.zeros((50, 6)), np.arange(50) / 60
    assert not touch_shares(forces, times).any()
    for force_n in (5e-324, 1.0, 1e300):
        forces[25] = force_n
        shares = touch_shares(forces, times)
        assert np.isfinite(shares).all()
        assert ((shares >= 0) & (shares <= 1)).all()
    for force_n in (np.nan, -1.0, np.inf):
        forces[25] = force_n
        with pytest.raises(InvalidInputError if force_n == -1.0 else NonFiniteError):
            touch_shares(forces, times)


def test_without_touch_commands_are_what_was_reached():
    hand, joints, Ts = RobotHand("left"), np.tile(CLOSED, (NUM, 1)), poses()
    commands = commands_from_touch(hand, Ts, joints, np.zeros((NUM, 6)), SERVOS)
    np.testing.assert_array_equal(commands.joints_rad, joints)
    np.testing.assert_array_equal(commands.Ts_world_wrist, Ts)


@pytest.mark.parametrize("side", SIDES)
def test_a_palm_alone_pushes_the_wrist_along_its_normal(side):
    hand, joints, Ts = RobotHand(side), np.tile(CLOSED, (NUM, 1)), poses()
    felt = np.zeros((NUM, 6))
    felt[:, 5] = 7.0
    commands = commands_from_touch(hand, Ts, joints, felt, SERVOS)
    lead = (invert(Ts) @ commands.Ts_world_wrist)[:, :3, 3]
    sign = 1.0 if side == "right" else -1.0
    # What the balance leaves open (1 mN) takes 0.04 % of it.
    np.testing.assert_allclose(lead, np.tile([0.0, sign * 0.01, 0.0], (NUM, 1)), atol=1e-5)
    np.testing.assert_array_equal(commands.joints_rad, joints)


@pytest.mark.parametrize("side", SIDES)
def test_one_finger_alone_presses_along_its_normal(side):
    hand, joints = RobotHand(side), np.tile(CLOSED, (NUM, 1))
    felt = np.zeros((NUM, 6))
    felt[:, 1] = 3.0
    forces = pressing_forces_n(hand, joints, felt)
    normal = hand.joint_frames(joints)[:, 1, 3, :3, 1] * (1.0 if side == "right" else -1.0)
    np.testing.assert_allclose(forces[:, 1], 3.0 * normal, rtol=1e-2)
    # It bends further: the command leads into the finger's flexion.
    commands = commands_from_touch(hand, poses(), joints, felt, SERVOS)
    assert (commands.joints_rad[:, 4] > joints[:, 4]).all()
    assert (commands.joints_rad[:, 6] > joints[:, 6]).all()


@pytest.mark.parametrize("side", SIDES)
def test_a_grasp_is_in_balance_and_leaves_the_wrist(side):
    hand, joints, Ts = RobotHand(side), np.tile(CLOSED, (NUM, 1)), poses()
    felt = np.tile([7.0, 4.0, 2.0, 1.0, 0.0, 0.0], (NUM, 1))
    forces = pressing_forces_n(hand, joints, felt)
    assert np.linalg.norm(forces.sum(axis=1), axis=-1).max() < 0.01
    places = robot_places_m(joints, hand)
    about = places - places.mean(axis=1, keepdims=True)
    assert np.linalg.norm(np.cross(about, forces).sum(axis=1), axis=-1).max() < 1e-3
    assert (forces[:, 4:] == 0).all()
    # Thumb and fingers press towards each other.
    between = places[:, 1] - places[:, 0]
    assert ((forces[:, 0] * between).sum(axis=-1) > 0).all()
    commands = commands_from_touch(hand, Ts, joints, felt, SERVOS)
    lead = (invert(Ts) @ commands.Ts_world_wrist)[:, :3, 3]
    assert np.abs(lead).max() < 1e-4


def test_stiffer_servos_lead_less():
    hand, joints, Ts = RobotHand("right"), np.tile(CLOSED, (NUM, 1)), poses()
    felt = np.tile([0.7, 0.4, 0.2, 0.1, 0.0, 0.0], (NUM, 1))
    soft = commands_from_touch(hand, Ts, joints, felt, SERVOS).joints_rad - joints
    stiff_servos = HandServos(finger_nm_rad=2.4, wrist_n_m=700.0, wrist_nm_rad=15.0)
    stiff = commands_from_touch(hand, Ts, joints, felt, stiff_servos).joints_rad - joints
    assert np.abs(soft).max() > 0.01
    np.testing.assert_allclose(soft, 2 * stiff, atol=1e-12)


def test_commands_stay_inside_the_limits():
    hand, joints = RobotHand("right"), np.tile(CLOSED, (NUM, 1))
    felt = np.tile([70.0, 40.0, 20.0, 10.0, 5.0, 0.0], (NUM, 1))
    commanded = commands_from_touch(hand, poses(), joints, felt, SERVOS).joints_rad
    assert (commanded >= hand.lower_rad).all()
    assert (commanded <= hand.upper_rad).all()
    assert ((commanded == hand.lower_rad) | (commanded == hand.upper_rad)).any()


def test_times_that_stand_are_refused():
    with pytest.raises(InvalidInputError, match="expected increasing times"):
        touch_shares(np.zeros((3, 6)), np.zeros(3))
