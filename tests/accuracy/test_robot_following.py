"""Whether the robot's hand could follow: hands that it can, and every cause for which it cannot."""

import sys
from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.errors import InvalidInputError
from dextouch.hands import FINGER_CHAINS, chain_indices, mean_hand_m
from dextouch.hands.robot_hand import RobotHand
from services.pipelines.robot_following import NUM_AXES_SAMPLES, RobotHandCheck
from services.twin.hands import HumanHand
from tests.accuracy.recorded_hand import needs_recording, recorded_keypoints_m
from tests.accuracy.test_retargeting import SIDES, keypoints_of, moving_joints

RATE_HZ = 30.0
# Axes of a right hand by which fingers bend to the palm and spread.
FLEXION, SPREAD = np.eye(3)[:2]


def followed(keypoints_m, side="right", calibration=None):
    """Share of samples that the robot cannot follow, and how often by finger and cause."""
    check = RobotHandCheck(side, calibration or {})
    # A still hand, of which the check learns that the axes are right.
    for sample in [keypoints_m[0]] * (NUM_AXES_SAMPLES - 1):
        assert check(sample, 1 / RATE_HZ) is None
    found = [check(sample, 1 / RATE_HZ) for sample in [keypoints_m[0], *keypoints_m]]
    causes = Counter(item for causes in found for item in causes.items())
    return np.mean([bool(causes) for causes in found]), causes


def bent(keypoints_m, finger, axis, angles_deg):
    """A hand whose finger is bent further, at each joint by so much, about an axis of the wrist."""
    points, nodes, total_deg = keypoints_m.copy(), chain_indices(finger)[-4:], 0.0
    for before, node, angle_deg in zip(nodes, nodes[1:], angles_deg, strict=False):
        total_deg += angle_deg
        turn = Rotation.from_rotvec(np.deg2rad(total_deg) * axis)
        points[node] = points[before] + turn.apply(keypoints_m[node] - keypoints_m[before])
    return points


def held(keypoints_m):
    return np.repeat(keypoints_m[None], 30, axis=0)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    ("hand", "natural"), [(RobotHand, True), (RobotHand, False), (HumanHand, True)]
)
def test_hands_that_the_robot_can_follow_have_no_cause(side, hand, natural):
    joints = moving_joints(hand(side), 600, 4, natural=natural)[::2]
    assert followed(keypoints_of(hand(side), joints), side) == (0.0, Counter())


def test_a_fist_beyond_the_limits_is_at_the_limit():
    """Of Wuji fingers the knuckle bends by 90 degrees, the others by 120 and 90."""
    hand = mean_hand_m("right")
    for finger in FINGER_CHAINS:
        hand = bent(hand, finger, FLEXION, [110, 110, 77])
    share, causes = followed(held(hand))
    assert share == 1.0
    assert {*causes} == {(finger, "limit") for finger in FINGER_CHAINS}


def test_fingers_that_spread_further_are_at_the_limit():
    """Wuji fingers spread by 40 degrees."""
    share, causes = followed(held(bent(mean_hand_m("right"), "index", SPREAD, [60, 0, 0])))
    assert (share, {*causes}) == (1.0, {("index", "limit")})
    assert followed(held(bent(mean_hand_m("right"), "index", SPREAD, [35, 0, 0])))[0] == 0.0


def test_a_finger_faster_than_the_joints_is_too_fast():
    """A joint that swings by 50 degrees at 1 Hz reaches 5.5 rad/s, at 4 Hz 22; the motors 9.6."""
    t_s = np.arange(90) / RATE_HZ

    def waving(rate_hz):
        swings = 1 - np.cos(2 * np.pi * rate_hz * t_s)
        hand, bends_deg = mean_hand_m("right"), swings[:, None] * [40, 50, 30]
        return np.stack([bent(hand, "index", FLEXION, bend_deg) for bend_deg in bends_deg])

    assert followed(waving(1.0)) == (0.0, Counter())
    share, causes = followed(waving(4.0))
    assert share > 0.3
    assert {*causes} == {("index", "speed")}


def test_a_thumb_longer_than_the_robots_is_out_of_reach():
    """It touches the tip of the straight index finger, which comes to meet it."""
    hand = mean_hand_m("right").copy()
    thumb, tip = chain_indices("thumb"), hand[chain_indices("index")[-1]]
    base = hand[thumb[0]]
    hand[thumb[1:]] = base + np.linspace(0, 1, 4)[1:, None] * (tip - base)
    share, causes = followed(held(hand))
    assert share == 1.0
    assert causes["index", "reach"] == 31
    # The thumb stretches as far as its joints go.
    assert causes["thumb", "reach"] + causes["thumb", "limit"] == 31
    assert {cause for _, cause in causes} <= {"reach", "limit"}


def test_a_finger_that_is_lost_is_not_tracked():
    keypoints = held(mean_hand_m("right"))
    keypoints[10:20, chain_indices("ring")] = np.nan
    share, causes = followed(keypoints)
    assert causes == Counter({("ring", "unseen"): 10})
    assert share == pytest.approx(10 / 31)


def test_a_finger_that_was_lost_is_not_too_fast_when_it_returns():
    """It returns as a fist, 100 degrees away: the robot's needs 0.18 s, six samples."""
    keypoints = held(mean_hand_m("right"))
    keypoints[20:] = bent(mean_hand_m("right"), "ring", FLEXION, [80, 100, 60])
    keypoints[10:20, chain_indices("ring")] = np.nan
    _, causes = followed(keypoints)
    assert {*causes} == {("ring", "unseen")}
    assert 12 <= causes["ring", "unseen"] <= 16


def test_turned_axes_are_refused_and_those_of_the_calibration_are_followed():
    R = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    joints = moving_joints(RobotHand("right"), 200, 1, natural=True)[::2]
    keypoints = keypoints_of(RobotHand("right"), joints)
    turned = keypoints @ R.T
    with pytest.raises(InvalidInputError, match=r"turned by 9\d degrees"):
        followed(turned)
    T_keypoints_wrist = np.eye(4)
    T_keypoints_wrist[:3, :3] = R
    calibration = {"T_keypoints_right_wrist_right": tuple(map(tuple, T_keypoints_wrist))}
    assert followed(turned, calibration=calibration) == (0.0, Counter())


@needs_recording
def test_a_recorded_hand_is_followed_most_of_the_time(capsys):
    """Everyday motion of a real hand: what it cannot follow is fast."""
    share, causes = followed(recorded_keypoints_m())
    by_cause = Counter(cause for _, cause in causes.elements())
    with capsys.disabled():
        sys.stdout.write(f"\nrecorded hand: not followed {share:.1%} | {dict(by_cause)}")
    assert 0.01 < share < 0.06
    assert by_cause.most_common(1)[0][0] == "speed"
