"""Motions of the retargeting benchmark: free of contact, as fast as stated, scored rightly."""

import numpy as np
import pytest

from benchmarks.retargeting.compare import score_pinches, score_robot
from benchmarks.simulated import hand_motions as sequences
from benchmarks.simulated.hand_motions import (
    BONE_SPREAD,
    MAX_SPEED_RAD_S,
    PINCHED_M,
    RATE_HZ,
    SIZES,
    Person,
    cold_postures,
    people,
    pinch_motion,
    robot_motion,
    segment_distance_m,
    touching,
    with_dropouts,
    with_noise,
)
from dextouch.errors import InvalidInputError, LimitExceededError, NonFiniteError
from dextouch.hands import NODE_INDEX
from dextouch.hands.robot_hand import RobotHand
from services.twin.hands import HumanHand, twin_hand
from services.twin.scene import scene_xml

SIDES = ("left", "right")


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("natural", [True, False])
def test_robot_motions_are_fast_free_of_contact_and_inside_limits(side, natural):
    motion = robot_motion(side, 240, 3, natural=natural)
    hand = twin_hand(side, "robot")
    speed = np.abs(np.diff(motion.joints_rad, axis=0)) * RATE_HZ
    assert 3.0 < speed.max() <= MAX_SPEED_RAD_S
    assert not touching(hand, motion.joints_rad).any()
    low, high = hand.kinematics.lower_rad, hand.kinematics.upper_rad
    assert ((motion.joints_rad >= low) & (motion.joints_rad <= high)).all()
    # Every joint moves, and most of them through much of what they can do.
    share = np.ptp(motion.joints_rad, axis=0) / (high - low)
    assert share.min() > 0.1
    assert share.mean() > (0.3 if natural else 0.5)
    again, other = (robot_motion(side, 240, seed, natural=natural) for seed in (3, 4))
    np.testing.assert_array_equal(motion.keypoints_m, again.keypoints_m)
    assert not np.allclose(motion.joints_rad, other.joints_rad)


def test_motions_that_are_too_fast_are_played_more_slowly(monkeypatch):
    usual = robot_motion("right", 120, 0, natural=False)
    fastest = np.abs(np.diff(usual.joints_rad, axis=0)).max() * RATE_HZ
    monkeypatch.setattr(sequences, "MAX_SPEED_RAD_S", 0.5 * fastest)
    slow = robot_motion("right", 120, 0, natural=False)
    assert np.abs(np.diff(slow.joints_rad, axis=0)).max() * RATE_HZ <= 0.5 * fastest
    np.testing.assert_allclose(slow.joints_rad[0], usual.joints_rad[0], atol=0.5)
    monkeypatch.setattr(sequences, "_MAX_TRIES", 1)
    with pytest.raises(LimitExceededError, match="another seed"):
        robot_motion("right", 120, 0, natural=False)


@pytest.mark.parametrize("side", SIDES)
def test_contact_of_fingers_is_what_mujoco_finds(side):
    mujoco = pytest.importorskip("mujoco")
    hand = twin_hand(side, "robot")
    model = mujoco.MjModel.from_xml_string(scene_xml((hand,), ""))
    data = mujoco.MjData(model)
    postures = cold_postures(side, 60, 5).joints_rad
    addresses = [model.joint(name).qposadr[0] for name in hand.kinematics.joint_names]
    links = [
        [model.geom(f"{side}_{name}_link{k}").id for k in (1, 2, 3)]
        for name in ("thumb", "index", "middle", "ring", "little")
    ]
    expected = np.zeros((len(postures), 5), dtype=bool)
    for row, posture in enumerate(postures):
        data.qpos[addresses] = posture
        mujoco.mj_kinematics(model, data)
        for a in range(5):
            for b in set(range(5)) - {a}:
                gaps = [
                    mujoco.mj_geomDistance(model, data, p, q, 0.5, None)
                    for p in links[a]
                    for q in links[b]
                ]
                expected[row, a] |= min(gaps) < 0
    found = touching(hand, postures)
    assert (found >= expected).all()
    # What we find beyond that is the palm, which the open hand does not touch.
    assert 0.1 < expected.mean() < found.mean()
    assert not touching(hand, np.zeros((1, 20))).any()
    fist = np.tile([1.5, 0.0, 2.0, 1.5], 5)[None]
    assert touching(hand, fist)[0, 1:].all()


@pytest.mark.parametrize(
    ("segments", "distance"),
    [
        (([0, 0, 0], [2, 0, 0], [1, -1, 3], [1, 1, 3]), 3.0),
        (([0, 0, 0], [1, 0, 0], [3, 0, 0], [4, 0, 0]), 2.0),
        (([0, 0, 0], [2, 0, 0], [1, 1, 0], [5, 1, 0]), 1.0),
        (([0, 0, 0], [1, 0, 0], [2, 1, 0], [2, 5, 0]), np.sqrt(2)),
        (([0, 0, 0], [4, 0, 0], [-3, 2, 0], [-1, 2, 0]), np.sqrt(5)),
    ],
)
def test_distance_of_segments(segments, distance):
    a, b, c, d = np.array(segments, dtype=np.float64)
    for ends in ((a, b, c, d), (c, d, a, b), (b, a, d, c)):
        assert segment_distance_m(*ends) == pytest.approx(distance)


def test_faults_are_put_into_keypoints_and_not_into_the_truth():
    motion, rng = robot_motion("left", 400, 0, natural=True), np.random.default_rng(1)
    noisy, lossy = with_noise(motion, 1e-3, rng), with_dropouts(motion, 0.1, rng)
    wrist = NODE_INDEX["wrist", "wrist"]
    off_m = np.delete(noisy.keypoints_m - motion.keypoints_m, wrist, axis=1)
    assert off_m.std() == pytest.approx(1e-3, rel=0.02)
    lost = np.isnan(lossy.keypoints_m).all(axis=-1)
    assert lost.sum() == np.isnan(lossy.keypoints_m).any(axis=-1).sum()
    assert np.delete(lost, wrist, axis=1).mean() == pytest.approx(0.1, rel=0.1)
    for changed in (noisy, lossy):
        assert (changed.keypoints_m[:, wrist] == 0).all()
        np.testing.assert_array_equal(changed.joints_rad, motion.joints_rad)


def bones_m(hand):
    points = hand.chain_points_m(np.zeros((1, 20)))[0]
    return np.linalg.norm(np.diff(points, axis=1), axis=-1)


@pytest.mark.parametrize("side", SIDES)
def test_people_are_of_their_size_with_bones_of_their_own(side):
    average = bones_m(HumanHand(side))
    for person, size in zip(people(side, 0), SIZES, strict=True):
        ratios = bones_m(person) / average / size
        assert np.abs(ratios - 1).max() <= BONE_SPREAD + 1e-9
        assert np.ptp(ratios) > BONE_SPREAD


@pytest.mark.parametrize("side", SIDES)
def test_pinches_close_with_every_finger_and_stay_inside_human_limits(side):
    person = people(side, 1)[4]
    motion = pinch_motion(person, side)
    assert len(motion) == 440
    for finger in range(4):
        closed = np.flatnonzero(motion.pinched[:, finger])
        # Held for about half a second, in this finger's quarter and nowhere else.
        assert 28 <= len(closed) <= 50
        assert (closed // 110 == finger).all()
        assert motion.gaps_m[closed, finger].max() < PINCHED_M
    tips = motion.keypoints_m[:, [NODE_INDEX["thumb", "tip"], NODE_INDEX["index", "tip"]]]
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(tips, axis=1)[:, 0], axis=-1), motion.gaps_m[:, 0], atol=1e-12
    )
    assert (motion.joints_rad >= person.lower_rad - 1e-9).all()
    assert (motion.joints_rad <= person.upper_rad + 1e-9).all()
    assert np.abs(np.diff(motion.joints_rad, axis=0)).max() * RATE_HZ < 6.0


def test_a_hand_that_cannot_pinch_is_refused():
    person = Person("right", 1.0, 0)
    # A thumb that points away and hardly moves.
    thumb = person.fingers[0]
    stiff = tuple(row._replace(limits_rad=(-0.6, -0.5)) for row in thumb.joints)
    HumanHand.__init__(person, "right", (thumb._replace(joints=stiff), *person.fingers[1:]))
    with pytest.raises(LimitExceededError, match="thumb and index"):
        pinch_motion(person, "right")


def test_scores_measure_what_was_changed():
    motion = robot_motion("right", 60, 0, natural=True)
    exact = score_robot([motion], [motion.joints_rad])
    assert (exact.tip_max_mm, exact.joint_max_deg, exact.num_outside) == (0, 0, 0)
    assert 1 < exact.max_step_deg < 9
    wrong = motion.joints_rad.copy()
    wrong[7, 3] += np.deg2rad(10)  # the outer joint of the thumb, 29.78 mm before its tip
    score = score_robot([motion, motion], [wrong, motion.joints_rad])
    assert score.joint_max_deg == pytest.approx(10)
    assert score.joint_mean_deg == pytest.approx(10 / (2 * 60 * 20))
    assert score.tip_max_mm == pytest.approx(2 * 29.78 * np.sin(np.deg2rad(5)))
    wrong[7, 3] = RobotHand("right").upper_rad[3] + 1e-5
    assert score_robot([motion], [wrong]).num_outside == 1
    with pytest.raises(InvalidInputError, match="expected the same"):
        score_robot([motion], [wrong[:-1]])
    wrong[0, 0] = np.nan
    with pytest.raises(NonFiniteError, match="motion 0"):
        score_robot([motion], [wrong])


def test_pinches_are_judged_where_people_pinch():
    motion = pinch_motion(people("right", 0)[2], "right")
    score = score_pinches([motion], [motion.joints_rad])
    assert score.same_angle_deg == 0
    assert score.num_pinched == motion.pinched.sum()
    # A person's angles on the robot's longer fingers leave the tips centimetres apart.
    assert 10 < score.gap_mean_mm < score.gap_p95_mm
    turned = motion.joints_rad + np.deg2rad(2)
    assert score_pinches([motion], [turned]).same_angle_deg == pytest.approx(2)
    never = type(motion)(**{**vars(motion), "gaps_m": motion.gaps_m + 1})
    with pytest.raises(InvalidInputError, match="no sample"):
        score_pinches([never], [turned])
