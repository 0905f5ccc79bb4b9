"""Missing, broken and impossible keypoints: masked, refused or bounded, never passed on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands import CHAINS, NODE_INDEX, NUM_KEYPOINTS, solver_indices
from dextouch.hands.robot_hand import HandModel, RobotHand
from services.alignment.retargeting import HandRetargeter, RetargetOptions, RetargetStatus
from services.alignment.retargeting.hand_retargeter import person_arrays
from services.alignment.retargeting.solver.arrays import SCRATCH, hand_arrays
from services.alignment.retargeting.solver.minimize import linearize

HAND = RobotHand("right")


def keypoints_of(joints_rad):
    points = HAND.chain_points_m(joints_rad)
    keypoints = np.zeros((len(joints_rad), NUM_KEYPOINTS, 3))
    for finger, chain in enumerate(CHAINS):
        keypoints[:, solver_indices(chain)] = points[:, finger]
    return keypoints


def bending(num_steps):
    return np.linspace(0.1, 0.6, num_steps)[:, None] * np.ones(20)


EXACT = RetargetOptions(temporal_weight_m2=0.0)
MIDDLE_NODES = ("proximal", "intermediate", "distal", "tip")


@pytest.mark.long
def test_slopes_are_the_derivative():
    hand = hand_arrays(HAND)
    person = person_arrays(None, HAND)
    person["travel"], person["knuckle_m"] = np.linspace(0, 1, 5), 0.01
    work = np.zeros(1, dtype=SCRATCH)
    work["scale"] = [0.7, 0.9, 1.1]
    joints = np.random.default_rng(0).uniform(hand["lower_rad"][0], hand["upper_rad"][0])

    def points_at(joints_rad, finger):
        linearize(hand[0], person[0], work[0], finger, joints_rad)
        return work["point"][0, finger].copy(), work["origin"][0, finger, 4].copy()

    for finger in range(5):
        points_at(joints[finger], finger)
        slope, own = (work[name][0, finger].copy() for name in ("slope", "own_slope"))
        for joint in range(4):
            step = np.zeros(6)
            step[joint] = 1e-6
            ahead, tip_ahead = points_at(joints[finger] + step, finger)
            behind, tip_behind = points_at(joints[finger] - step, finger)
            np.testing.assert_allclose(slope[:, joint], (ahead - behind) / 2e-6, atol=1e-8)
            np.testing.assert_allclose(own[3, joint], (tip_ahead - tip_behind) / 2e-6, atol=1e-8)


def slanted(hand):
    """The same fingers with hinges about other axes, of all kinds."""
    axes = [(0.0, 0.0, 1.0), (0.6, -0.8, 0.0), (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)]
    fingers = [
        finger._replace(
            joints=tuple(
                row._replace(axis=axes[(number + joint) % 4])
                for joint, row in enumerate(finger.joints)
            )
        )
        for number, finger in enumerate(hand.fingers)
    ]
    return HandModel("right", fingers, name="slanted")


@pytest.mark.long
@pytest.mark.parametrize("model", [HAND, slanted(HAND)], ids=["Wuji", "slanted"])
def test_points_of_the_solver_are_those_of_the_hand(model):
    hand = hand_arrays(model)
    person = person_arrays(None, model)
    work = np.zeros(1, dtype=SCRATCH)
    work["scale"] = 1.0
    joints = np.random.default_rng(1).uniform(hand["lower_rad"][0], hand["upper_rad"][0])
    expected = model.chain_points_m(joints[:, :4].reshape(1, 20))[0]
    for finger in range(5):
        linearize(hand[0], person[0], work[0], finger, joints[finger])
        np.testing.assert_allclose(work["point"][0, finger], expected[finger], atol=1e-12)


def test_missing_nodes_are_filled_and_told():
    joints = bending(9)
    keypoints = keypoints_of(joints)
    keypoints[3:5, NODE_INDEX["ring", "distal"]] = np.nan
    keypoints[1, [NODE_INDEX["index", "distal"], NODE_INDEX["index", "tip"]]] = np.nan
    keypoints[7] = np.nan
    result = HandRetargeter("right", options=EXACT).retarget(keypoints)
    assert result.status.tolist() == [0, 1, 0, 1, 1, 0, 0, RetargetStatus.MISSING, 0]
    ring, index = CHAINS.index("ring"), CHAINS.index("index")
    assert result.finger_status[3, ring] == RetargetStatus.PARTIAL
    assert result.solved[3, ring]
    assert result.finger_status[1, index] == RetargetStatus.MISSING
    assert not result.solved[1, index]
    np.testing.assert_allclose(result.joints_rad, joints, atol=1e-6)


def test_live_samples_are_those_of_a_recording():
    rng = np.random.default_rng(4)
    keypoints = keypoints_of(bending(30)) + rng.normal(scale=1e-3, size=(30, NUM_KEYPOINTS, 3))
    profile = HandRetargeter("right").measure(keypoints)
    whole = HandRetargeter("right", profile).retarget(keypoints)
    live = HandRetargeter("right", profile)
    single = np.concatenate([live.step(sample).joints_rad for sample in keypoints])
    np.testing.assert_array_equal(single, whole.joints_rad)
    live.reset()
    np.testing.assert_array_equal(live.step(keypoints[0]).joints_rad[0], single[0])


def test_lost_fingers_hold_and_are_searched_again():
    keypoints = keypoints_of(bending(40))
    live = HandRetargeter("right", HandRetargeter("right").measure(keypoints), EXACT)
    for sample in keypoints[:10]:
        before = live.step(sample)
    gone = live.step(np.full((NUM_KEYPOINTS, 3), np.nan))
    assert gone.status[0] == RetargetStatus.MISSING
    np.testing.assert_array_equal(gone.joints_rad, before.joints_rad)
    bones = keypoints[20].copy()
    bones[NODE_INDEX["middle", "tip"]] += 0.05
    wrong = live.step(bones)
    middle = CHAINS.index("middle")
    assert wrong.finger_status[0, middle] == RetargetStatus.IMPLAUSIBLE
    np.testing.assert_array_equal(
        wrong.joints_rad[0, 4 * middle :][:4], before.joints_rad[0, 4 * middle :][:4]
    )
    # 0.37 rad are two steps of at most 0.32 rad, however long it was lost.
    on_the_way = live.step(keypoints[39], elapsed_s=1.0)
    assert on_the_way.status[0] == RetargetStatus.REACQUIRED
    again = live.step(keypoints[39])
    assert again.status[0] == RetargetStatus.SOLVED
    np.testing.assert_allclose(again.joints_rad[0], bending(40)[39], atol=1e-6)


def test_no_joint_is_faster_than_the_limit():
    there = keypoints_of(bending(2))[[0] * 5 + [1] * 20]
    options = RetargetOptions(velocity_limit_rad_s=1.0, temporal_weight_m2=0.0)
    result = HandRetargeter("right", options=options).retarget(there)
    steps_rad = np.abs(np.diff(result.joints_rad, axis=0))
    assert steps_rad.max() == pytest.approx(1 / 60)
    slow = HandRetargeter("right", options=options).retarget(there, t_s=np.arange(25.0))
    np.testing.assert_allclose(slow.joints_rad[-1], bending(2)[1], atol=1e-6)


@pytest.mark.parametrize("elapsed_s", [1 / 120, 1 / 60, 1 / 30])
def test_the_sample_before_pulls_by_the_time_since(elapsed_s):
    """One small step against the normal equations: (J'J + pull) dq = J'J dq of the hand."""
    options, little = RetargetOptions(), slice(16, 20)
    before = np.full(20, 0.3)
    wanted = before.copy()
    wanted[little] += [0.004, -0.003, 0.006, 0.005]
    live = HandRetargeter("right", options=options)
    found = [live.step(keypoints_of(before[None])[0]) for _ in range(3)][-1].joints_rad[0]
    moved = live.step(keypoints_of(wanted[None])[0], elapsed_s=elapsed_s).joints_rad[0] - found
    # Slopes of the bones by central differences; without a profile they count as of 40 mm each.
    ahead, behind = (
        np.diff(HAND.chain_points_m(before + sign * 1e-5 * np.eye(20)[little])[:, 4], axis=1)
        for sign in (1, -1)
    )
    slopes = 0.04 * (ahead - behind) / 2e-5 / np.linalg.norm(ahead, axis=-1, keepdims=True)
    J = slopes.reshape(4, -1).T
    # m²/rad² at 60 Hz; at twice the rate twice as much.
    pull = options.temporal_weight_m2 / 60 / elapsed_s
    expected = np.linalg.solve(J.T @ J + pull * np.eye(4), J.T @ J @ (wanted - before)[little])
    np.testing.assert_allclose(moved[little], expected, atol=4e-5)


@pytest.mark.parametrize(("share", "is_believed"), [(0.9, True), (0.5, False), (1.5, False)])
def test_bones_of_another_length_are_not_this_hands(share, is_believed):
    keypoints = keypoints_of(bending(30))
    live = HandRetargeter("right", HandRetargeter("right").measure(keypoints))
    live.step(keypoints[0])
    sample, middle = keypoints[1].copy(), CHAINS.index("middle")
    knuckle, *further = (NODE_INDEX["middle", name] for name in MIDDLE_NODES)
    # The first bone is shorter or longer, all others are as before: 45 mm by 10 or 50 %.
    sample[further] += (share - 1) * (sample[further[0]] - sample[knuckle])
    expected = np.zeros(5)
    expected[middle] = RetargetStatus.SOLVED if is_believed else RetargetStatus.IMPLAUSIBLE
    np.testing.assert_array_equal(live.step(sample).finger_status[0], expected)


def test_hands_of_other_fingers_and_joints_are_followed():
    thumb, index, middle, *_ = HAND.fingers
    extra = index.joints[0]._replace(name="twist", position_m=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    twisted = middle._replace(joints=(extra, *middle.joints), points=(2, 3, 4))
    hand = HandModel("right", (thumb, index, twisted), name="three fingers")
    low, high = 0.8 * hand.lower_rad, 0.8 * hand.upper_rad
    waves = np.sin(np.arange(120)[:, None] / 15 + np.arange(13))
    joints = low + (high - low) * (0.5 + 0.4 * waves)
    points = hand.chain_points_m(joints)
    keypoints = keypoints_of(np.zeros((120, 20)))
    for finger, table in enumerate(hand.fingers):
        keypoints[:, solver_indices(table.chain)] = points[:, finger]
    result = HandRetargeter(hand, options=EXACT).retarget(keypoints)
    assert result.joints_rad.shape == (120, 13)
    assert result.finger_status.shape == (120, 3)
    reached = hand.chain_points_m(result.joints_rad)
    np.testing.assert_allclose(reached, points, atol=1e-6)


def test_two_bones_may_be_one_of_the_robots():
    thumb, index, *others = HAND.fingers
    stiff = index._replace(joints=index.joints[:3], points=(1, 2, 2), tip_m=(0.0, 0.0, -0.05425))
    hand = HandModel("right", (thumb, stiff, *others), name="stiff index")
    joints = bending(20)
    joints[:, 7] = 0.0
    result = HandRetargeter(hand, options=EXACT).retarget(keypoints_of(joints))
    assert (result.status == RetargetStatus.SOLVED).all()
    np.testing.assert_allclose(result.joints_rad, np.delete(joints, 7, axis=1), atol=1e-6)


def test_times_must_rise():
    with pytest.raises(InvalidInputError, match="sample 2"):
        HandRetargeter("right").retarget(keypoints_of(bending(3)), t_s=np.array([0.0, 0.1, 0.1]))
    with pytest.raises(ShapeError):
        HandRetargeter("right").retarget(keypoints_of(bending(3)), t_s=np.zeros(2))
    with pytest.raises(InvalidInputError, match="elapsed_s"):
        HandRetargeter("right").step(keypoints_of(bending(1))[0], elapsed_s=0.0)


def test_options_are_checked():
    with pytest.raises(InvalidInputError, match=r"num_starts 9 \(expected 1 … 8\)"):
        RetargetOptions(num_starts=9)
    with pytest.raises(InvalidInputError, match="pinch_far_m"):
        RetargetOptions(pinch_far_m=0.001)
    with pytest.raises(InvalidInputError, match="temporal_weight_m2 nan"):
        RetargetOptions(temporal_weight_m2=np.nan)
    with pytest.raises(InvalidInputError, match="temporal_weight_m2 inf"):
        RetargetOptions(temporal_weight_m2=np.inf)


def test_single_step_is_enough():
    result = HandRetargeter("right", options=EXACT).retarget(keypoints_of(bending(1)))
    np.testing.assert_allclose(result.joints_rad, bending(1), atol=1e-6)


def test_millimetres_are_refused():
    with pytest.raises(InvalidInputError, match="millimetres"):
        HandRetargeter("right").retarget(keypoints_of(bending(3)) * 1e3)


def test_finger_that_is_never_seen_is_named():
    keypoints = keypoints_of(bending(3))
    keypoints[:, NODE_INDEX["little", "tip"]] = np.inf
    with pytest.raises(InvalidInputError, match="little"):
        HandRetargeter("right").retarget(keypoints)


def test_wrong_shapes_are_refused():
    with pytest.raises(ShapeError):
        HandRetargeter("right").retarget(np.zeros((2, 21, 3)))
    with pytest.raises(ShapeError):
        HandRetargeter("right").retarget(np.zeros((0, 25, 3)))
    with pytest.raises(ShapeError):
        HandRetargeter("right").retarget(keypoints_of(bending(2)), t_s=np.ones(3))


def test_limits_hold_exactly_for_hands_bent_too_far():
    hand = RobotHand("right")
    bent_too_far = np.broadcast_to(hand.upper_rad + 0.2, (4, 20))
    result = HandRetargeter("right").retarget(keypoints_of(bent_too_far))
    assert (result.joints_rad <= hand.upper_rad).all()
    assert (result.joints_rad == hand.upper_rad).any()


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from(["nan", "inf", "zero", "outlier", "tiny", "swap"]))
def test_broken_nodes_never_leave_the_limits(seed, kind):
    rng = np.random.default_rng(seed)
    keypoints = keypoints_of(bending(6))
    broken = rng.random((6, NUM_KEYPOINTS)) < 0.15
    broken[0] = False
    replacement = {
        "nan": np.nan,
        "inf": np.inf,
        "zero": 0.0,
        "outlier": keypoints + rng.normal(scale=0.05, size=keypoints.shape),
        "tiny": 5e-324,
        "swap": keypoints[:, rng.permutation(NUM_KEYPOINTS)],
    }[kind]
    keypoints = np.where(broken[..., None], replacement, keypoints)
    try:
        result = HandRetargeter("right").retarget(keypoints)
    except InvalidInputError:
        return
    assert np.isfinite(result.joints_rad).all()
    assert (result.joints_rad >= HAND.lower_rad).all()
    assert (result.joints_rad <= HAND.upper_rad).all()
    assert np.isfinite(result.tip_error_m).all()


def test_trackers_without_metacarpals_are_followed_alike():
    keypoints = keypoints_of(bending(40))
    whole = HandRetargeter("right").retarget(keypoints)
    for chain in CHAINS[1:]:
        keypoints[:, NODE_INDEX[chain, "metacarpal"]] = np.nan
    lacking = HandRetargeter("right").retarget(keypoints)
    np.testing.assert_array_equal(lacking.joints_rad, whole.joints_rad)
