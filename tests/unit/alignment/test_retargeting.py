"""Missing, broken and impossible keypoints: masked, refused or bounded, never passed on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands.robot_hand import RobotHand
from dextouch.hands.skeleton import CHAINS, NODE_INDEX, NUM_KEYPOINTS, solver_indices
from services.alignment.retargeting import HandRetargeter, RetargetStatus
from services.alignment.retargeting.finger_solver import FingerSolver

HAND = RobotHand("right")


def keypoints_of(joints_rad):
    points = HAND.chain_points_m(joints_rad)
    keypoints = np.zeros((len(joints_rad), NUM_KEYPOINTS, 3))
    for finger, chain in enumerate(CHAINS):
        keypoints[:, solver_indices(chain)] = points[:, finger]
    return keypoints


def bending(num_steps):
    return np.linspace(0.1, 0.6, num_steps)[:, None] * np.ones(20)


def test_jacobian_is_the_derivative():
    solver = FingerSolver(HAND)
    rng = np.random.default_rng(0)
    joints = rng.uniform(solver.lower_rad, solver.upper_rad, (4, 5, 4))
    targets = rng.normal(scale=0.05, size=(4, 5, 3, 3))
    _, jacobian = solver._linearize(joints, targets)
    for joint in range(4):
        step = np.zeros(4)
        step[joint] = 1e-6
        ahead, _ = solver._linearize(joints + step, targets)
        behind, _ = solver._linearize(joints - step, targets)
        np.testing.assert_allclose(jacobian[..., joint], (ahead - behind) / 2e-6, atol=1e-8)


def test_missing_nodes_are_interpolated_and_told():
    joints = bending(9)
    keypoints = keypoints_of(joints)
    keypoints[3:5, NODE_INDEX["ring", "distal"]] = np.nan
    valid = np.ones((9, NUM_KEYPOINTS), dtype=bool)
    valid[7] = False
    result = HandRetargeter("right").retarget(keypoints, valid)
    assert result.status.tolist() == [0, 0, 0, 1, 1, 0, 0, RetargetStatus.MISSING, 0]
    assert not result.solved[3, CHAINS.index("ring")]
    np.testing.assert_allclose(result.joints_rad, joints, atol=1e-6)


def test_single_step_is_enough():
    result = HandRetargeter("right").retarget(keypoints_of(bending(1)))
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
        HandRetargeter("right").retarget(keypoints_of(bending(2)), np.ones(2, dtype=bool))


def test_limits_hold_exactly_for_hands_bent_too_far():
    hand = RobotHand("right")
    bent_too_far = np.broadcast_to(hand.upper_rad + 0.5, (4, 20))
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
