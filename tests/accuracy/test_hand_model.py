"""The built-in Wuji Hand 2 against MuJoCo's kinematics of the maker's own model, both hands."""

import sys
import time

import mujoco
import numpy as np
import pytest

from dextouch.hands.hand_files import load_hand
from dextouch.hands.robot_hand import RobotHand
from tests.unit.hands.hand_texts import official_model, wuji_mapping
from tests.unit.hands.mujoco_chains import MujocoChains, hand_hinges, random_angles

SIDES = ("left", "right")
NUM_POSES = 1000
BOUND_M = 1e-6
TABLE_BOUND = 1e-9
IDENTITY = np.eye(3)


def official(side):
    model = mujoco.MjModel.from_xml_path(str(official_model(side)))
    return model, MujocoChains(model, f"{side[0]}_wrist", IDENTITY)


def tip_sites(model):
    """The maker's fingertips: the sites that it calls so, in the order of its file."""
    return [model.site(index).name for index in range(model.nsite)]


@pytest.mark.long
@pytest.mark.parametrize("side", SIDES)
def test_wuji_tables_agree_with_the_makers_model(side, capsys):
    hand = RobotHand(side)
    model, chains = official(side)
    tips = tip_sites(model)
    assert len(tips) == 5
    assert all(name.endswith("_tip") for name in tips)
    joints = random_angles(hand, NUM_POSES, seed=0)
    began = time.perf_counter()
    origins, axes = hand_hinges(hand, joints)
    points = hand.fingertips_m(joints)
    pose_us = (time.perf_counter() - began) / NUM_POSES * 1e6
    worst_m = dict.fromkeys(("joint origins in m", "joint axes", "fingertips in m"), 0.0)
    for index, angles in enumerate(joints):
        chains.pose(hand.joint_names, angles)
        anchors, directions = chains.hinges(hand.joint_names)
        seen = np.array([chains.site(name) for name in tips])
        apart = origins[index] - anchors, axes[index] - directions, points[index] - seen
        for what, difference in zip(worst_m, apart, strict=True):
            worst_m[what] = max(worst_m[what], float(np.abs(difference).max()))
    with capsys.disabled():
        for what, error in worst_m.items():
            sys.stdout.write(
                f"\n{side} hand, {NUM_POSES} poses over all limits, {what}: "
                f"{pose_us:.1f} µs a pose | largest difference {error:.1e} | bound {BOUND_M:.0e}"
            )
    assert max(worst_m.values()) <= BOUND_M


@pytest.mark.parametrize("side", SIDES)
def test_wuji_joints_are_the_makers(side):
    hand = RobotHand(side)
    model, _ = official(side)
    assert model.njnt == len(hand.joint_names)
    joints = [model.joint(index) for index in range(model.njnt)]
    # The file lists thumb, index, middle, ring, little from the wrist outwards, as the firmware.
    assert [joint.name for joint in joints] == list(hand.joint_names)
    limits = np.stack([hand.lower_rad, hand.upper_rad], axis=1)
    np.testing.assert_array_equal(np.array([joint.range for joint in joints]), limits)
    axes = np.array([row.axis for finger in hand.fingers for row in finger.joints])
    np.testing.assert_array_equal(np.array([joint.axis for joint in joints]), axes)


@pytest.mark.parametrize("side", SIDES)
def test_wuji_model_loads_as_the_built_in_tables(side, tmp_path):
    mapping = tmp_path / f"{side}.toml"
    mapping.write_text(wuji_mapping(side), encoding="utf-8")
    loaded, hand = load_hand(official_model(side), mapping), RobotHand(side)
    assert loaded.side == side
    assert len(loaded.fingers) == len(hand.fingers)
    for got, built_in in zip(loaded.fingers, hand.fingers, strict=True):
        assert (got.chain, got.points) == (built_in.chain, built_in.points)
        np.testing.assert_allclose(got.tip_m, built_in.tip_m, rtol=0, atol=TABLE_BOUND)
        for row, wanted in zip(got.joints, built_in.joints, strict=True):
            assert (row.name, row.limits_rad) == (wanted.name, wanted.limits_rad)
            np.testing.assert_allclose(row.position_m, wanted.position_m, rtol=0, atol=TABLE_BOUND)
            np.testing.assert_allclose(row.axis, wanted.axis, rtol=0, atol=TABLE_BOUND)
            # The file's six digits are no unit quaternion; the loader's are.
            unit = np.array(wanted.q_wxyz) / np.linalg.norm(wanted.q_wxyz)
            np.testing.assert_allclose(row.q_wxyz, unit, rtol=0, atol=TABLE_BOUND)
