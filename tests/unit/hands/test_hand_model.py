"""Hand models of any shape: kinematics against a walk along each finger, and what is refused."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError, UnknownNameError
from dextouch.geometry.rotations import rotation_from_quaternion, rotation_from_vector
from dextouch.hands import CHAINS, FingerTable, JointRow
from dextouch.hands.robot_hand import HandModel, RobotHand, chain_points_of_both_m
from services.twin.hands import HumanHand


def row(name, seed, *, limits=(-0.5, 1.2)):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    place, turn = rng.normal(0, 0.03, 3), rng.normal(size=4)
    return JointRow(name, tuple(place), tuple(turn), tuple(axis), limits)


def finger(chain, num_hinges, points, seed):
    rows = tuple(row(f"{chain}_{index}", seed + index) for index in range(num_hinges))
    return FingerTable(chain, rows, (0.001 * seed, -0.002, -0.03), points)


MIXED = HandModel(
    "right",
    [
        finger("index", 1, (0, 0, 0), 10),
        finger("thumb", 6, (1, 3, 5), 20),
        finger("little", 2, (0, 1, 1), 30),
    ],
    name="mixed",
)


def walked_points_m(table, angles):
    """The plain way: one finger, one hinge after the other."""
    R, t = np.eye(3), np.zeros(3)
    origins = []
    for joint, angle in zip(table.joints, angles, strict=True):
        t = t + R @ np.array(joint.position_m)
        R = R @ rotation_from_quaternion(np.array(joint.q_wxyz))
        R = R @ rotation_from_vector(angle * np.array(joint.axis))
        origins.append(t)
    return np.array([*(origins[index] for index in table.points), t + R @ np.array(table.tip_m)])


@pytest.mark.parametrize("hand", [MIXED, RobotHand("left"), HumanHand("right")])
def test_points_are_those_of_a_walk_along_each_finger(hand):
    rng = np.random.default_rng(3)
    joints = rng.uniform(hand.lower_rad, hand.upper_rad, (20, len(hand.joint_names)))
    points = hand.chain_points_m(joints)
    assert points.shape == (20, len(hand.fingers), 4, 3)
    begin = 0
    for index, table in enumerate(hand.fingers):
        end = begin + len(table.joints)
        for sample, angles in enumerate(joints[:, begin:end]):
            wanted = walked_points_m(table, angles)
            np.testing.assert_allclose(points[sample, index], wanted, rtol=0, atol=1e-14)
        begin = end
    np.testing.assert_array_equal(hand.fingertips_m(joints), points[:, :, 3])


def test_joint_vector_is_finger_by_finger():
    assert MIXED.joint_names[:3] == ("index_0", "thumb_0", "thumb_1")
    assert len(MIXED.joint_names) == len(MIXED.lower_rad) == len(MIXED.upper_rad) == 9
    joints = np.zeros((2, 9))
    joints[1, 7:] = 0.4
    moved = np.abs(np.diff(MIXED.fingertips_m(joints), axis=0)[0]).max(axis=-1)
    assert moved[2] > 1e-3
    np.testing.assert_array_equal(moved[:2], 0)


def test_frames_of_shorter_fingers_repeat_their_last():
    frames = MIXED.joint_frames(np.full((2, 9), 0.3))
    assert frames.shape == (2, 3, 6, 4, 4)
    np.testing.assert_array_equal(frames[:, 0], frames[:, 0, :1].repeat(6, axis=1))
    np.testing.assert_array_equal(frames[:, 2, 1:], frames[:, 2, 1:2].repeat(5, axis=1))


@pytest.mark.parametrize("side", ["left", "right"])
def test_wuji_hand_is_five_fingers_of_four(side):
    hand = RobotHand(side)
    assert tuple(table.chain for table in hand.fingers) == CHAINS
    assert {table.points for table in hand.fingers} == {(1, 2, 3)}
    assert hand.joint_frames(np.zeros((3, 20))).shape == (3, 5, 4, 4, 4)
    assert hand.lower_rad.shape == hand.upper_rad.shape == (20,)
    assert all(name.startswith(f"{side[0]}_") for name in hand.joint_names)


@pytest.mark.parametrize("count", [8, 10])
def test_wrong_number_of_angles_is_refused(count):
    with pytest.raises(ShapeError, match=r"expected \[T, 9\]"):
        MIXED.joint_frames(np.zeros((2, count)))


def test_nan_angles_are_refused():
    with pytest.raises(NonFiniteError, match="right hand"):
        MIXED.fingertips_m(np.full((1, 9), np.nan))


def test_unknown_side_is_refused():
    for make in (RobotHand, lambda side: HandModel(side, MIXED.fingers, name="mixed")):
        with pytest.raises(UnknownNameError, match="unknown side 'l'; valid: left, right"):
            make("l")


GOOD = finger("index", 3, (0, 1, 2), 40)
FIRST = GOOD.joints[0]
NAN = float("nan")


def with_first(**changes):
    return GOOD._replace(joints=(FIRST._replace(**changes), *GOOD.joints[1:]))


@pytest.mark.parametrize(
    ("fingers", "error", "message"),
    [
        ([], InvalidInputError, "no finger"),
        ([GOOD, GOOD], InvalidInputError, "chain 'index' appears twice"),
        ([GOOD, GOOD._replace(chain="ring")], InvalidInputError, "'index_0' appears twice"),
        ([GOOD._replace(chain="pinky")], UnknownNameError, "'pinky'; valid: index, little"),
        ([GOOD._replace(joints=())], InvalidInputError, "got 0 hinges, expected 1 … 6"),
        ([finger("index", 7, (0, 1, 2), 1)], InvalidInputError, "got 7 hinges"),
        ([GOOD._replace(points=(0, 2, 1))], InvalidInputError, r"got hinges \(0, 2, 1\)"),
        ([GOOD._replace(points=(0, 1, 3))], InvalidInputError, "indices of its 3 hinges"),
        ([GOOD._replace(points=(-1, 1, 2))], InvalidInputError, "indices of its 3 hinges"),
        ([GOOD._replace(tip_m=(0.0, NAN, 0.0))], NonFiniteError, "'index': tip"),
        ([with_first(limits_rad=(1.0, 0.5))], InvalidInputError, "expected lower < upper"),
        ([with_first(limits_rad=(0.5, 0.5))], InvalidInputError, "'index_0'"),
        ([with_first(limits_rad=(NAN, 0.5))], NonFiniteError, "limits_rad"),
        ([with_first(axis=(0.0, 0.0, 0.9))], InvalidInputError, "axis of length 0.9"),
        ([with_first(q_wxyz=(0.0, 0.0, 0.0, 0.0))], InvalidInputError, "quaternion of zeros"),
        ([with_first(position_m=(0.0, np.inf, 0.0))], NonFiniteError, "position_m"),
    ],
)
def test_tables_that_are_no_hand_are_refused(fingers, error, message):
    with pytest.raises(error, match=message):
        HandModel("left", fingers, name="broken")


@pytest.mark.parametrize("num_steps", [1, 16])
def test_both_hands_together_are_each_alone(num_steps):
    joints_rad = np.random.default_rng(5).uniform(-0.5, 1.5, (num_steps, 2, 20))
    together = chain_points_of_both_m(joints_rad)
    for index, side in enumerate(("left", "right")):
        alone = RobotHand(side).chain_points_m(joints_rad[:, index])
        np.testing.assert_array_equal(together[:, index], alone)
