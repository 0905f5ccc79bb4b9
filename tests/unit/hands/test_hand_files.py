"""Hands from files against MuJoCo's reading of the same files."""

import mujoco
import numpy as np
import pytest

from dextouch.hands.hand_files import load_hand
from tests.unit.hands.hand_texts import documented_mappings, four_finger_urdf, write_hand
from tests.unit.hands.mujoco_chains import MujocoChains, hand_hinges, random_angles
from tests.unit.hands.random_mjcf import INERTIAL, random_chain

TOLERANCE_M = 1e-12
IDENTITY = np.eye(3)
# Wrist axes of the four-finger hand's mapping: thumb side +y, fingers +z, so that our y is its x.
R_FOUR = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
MUJOCO_OPTIONS = (
    '<mujoco><compiler fusestatic="false" boundmass="1e-6" boundinertia="1e-9"/></mujoco></robot>'
)
THUMB = """
side = "left"
[wrist]
body = "w"
fingers_along = [0, 0, -1]
thumb_side = [1, 0, 0]
[[fingers]]
chain = "thumb"
joints = [{joints}]
knuckle = "j0"
pip = "j1"
dip = "j2"
tip = {{ {tip} }}
"""


def four_fingers(tmp_path, mapping=None):
    return load_hand(*write_hand(tmp_path, four_finger_urdf(), mapping or documented_mappings()[1]))


def test_four_fingers_of_urdf_move_as_in_mujoco(tmp_path):
    hand = four_fingers(tmp_path)
    assert hand.name == "four_fingers"
    assert hand.joint_names == tuple(f"joint_{number}" for number in range(16))
    model = mujoco.MjModel.from_xml_string(four_finger_urdf().replace("</robot>", MUJOCO_OPTIONS))
    chains = MujocoChains(model, "wrist", R_FOUR)
    joints = random_angles(hand, 100, seed=1)
    origins, axes = hand_hinges(hand, joints)
    tips = hand.fingertips_m(joints)
    for index, angles in enumerate(joints):
        chains.pose(hand.joint_names, angles)
        anchors, directions = chains.hinges(hand.joint_names)
        np.testing.assert_allclose(origins[index], anchors, rtol=0, atol=TOLERANCE_M)
        np.testing.assert_allclose(axes[index], directions, rtol=0, atol=TOLERANCE_M)
        wanted = [chains.body(f"{chain}_tip") for chain in ("index", "middle", "ring")]
        wanted.append(chains.body("link_15", (0, 0, 0.0543)))
        np.testing.assert_allclose(tips[index], wanted, rtol=0, atol=TOLERANCE_M)


def test_order_of_the_mapping_is_the_order_of_the_joints(tmp_path):
    head, *fingers = documented_mappings()[1].split("[[fingers]]")
    thumb_first = "[[fingers]]".join([head, fingers[-1], *fingers[:-1]])
    hand, other = four_fingers(tmp_path), four_fingers(tmp_path, thumb_first)
    assert other.joint_names == (*hand.joint_names[12:], *hand.joint_names[:12])
    joints = random_angles(hand, 5, seed=2)
    moved = other.fingertips_m(np.roll(joints, 4, axis=1))
    np.testing.assert_array_equal(moved, np.roll(hand.fingertips_m(joints), 1, axis=1))


def test_wrist_origin_and_lengths_of_directions(tmp_path):
    text = documented_mappings()[1]
    moved = text.replace("fingers_along = [0, 0, 1]", "fingers_along = [0, 0, 3]").replace(
        "thumb_side = [0, 1, 0]", "thumb_side = [0, 0.5, 0]\norigin_m = [0.01, 0.02, 0.03]"
    )
    joints = random_angles(four_fingers(tmp_path), 5, seed=3)
    apart = four_fingers(tmp_path).fingertips_m(joints) - four_fingers(
        tmp_path, moved
    ).fingertips_m(joints)
    shift = R_FOUR.T @ np.array([0.01, 0.02, 0.03])
    np.testing.assert_allclose(apart, np.broadcast_to(shift, apart.shape), rtol=0, atol=1e-15)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(40))
def test_random_mjcf_chains_move_as_in_mujoco(seed, tmp_path):
    num_hinges = 3 + seed % 4
    text = random_chain(seed, num_hinges)
    names = [f"j{index}" for index in range(num_hinges)]
    mapping = THUMB.format(
        joints=str(names)[1:-1], tip='site = "tip", offset_m = [0.01, 0.02, 0.03]'
    )
    hand = load_hand(*write_hand(tmp_path, text, mapping))
    model = mujoco.MjModel.from_xml_string(text)
    chains = MujocoChains(model, "w", IDENTITY)
    limits = np.array([model.joint(name).range for name in names])
    np.testing.assert_allclose(np.stack([hand.lower_rad, hand.upper_rad], -1), limits, atol=1e-15)
    joints = random_angles(hand, 10, seed)
    origins, axes = hand_hinges(hand, joints)
    tips = hand.fingertips_m(joints)
    for index, angles in enumerate(joints):
        chains.pose(names, angles)
        anchors, directions = chains.hinges(names)
        np.testing.assert_allclose(origins[index], anchors, rtol=0, atol=TOLERANCE_M)
        np.testing.assert_allclose(axes[index], directions, rtol=0, atol=TOLERANCE_M)
        tip = chains.site("tip", (0.01, 0.02, 0.03))
        np.testing.assert_allclose(tips[index, 0], tip, rtol=0, atol=TOLERANCE_M)


def test_half_turns_of_zaxis_are_mujocos(tmp_path):
    text = (
        f'<mujoco><worldbody><body name="w">{INERTIAL}<body zaxis="0 0 -2">{INERTIAL}'
        '<joint name="j0" range="-60 60" axis="1 2 3"/><joint name="j1" range="-9 9" axis="1 0 0"/>'
        '<joint name="j2" range="-9 9" axis="0 1 0"/><site name="tip" pos="0.01 0.02 0.03"/>'
        "</body></body></worldbody></mujoco>"
    )
    mapping = THUMB.format(joints='"j0", "j1", "j2"', tip='site = "tip"')
    hand = load_hand(*write_hand(tmp_path, text, mapping))
    chains = MujocoChains(mujoco.MjModel.from_xml_string(text), "w", IDENTITY)
    chains.pose(hand.joint_names, np.zeros(3))
    np.testing.assert_allclose(
        hand.fingertips_m(np.zeros((1, 3)))[0, 0], chains.site("tip"), atol=1e-15
    )


def test_one_hinge_is_knuckle_pip_and_dip(tmp_path):
    text = (
        '<robot name="one"><link name="w"/><link name="f"/><joint name="j" type="revolute">'
        '<parent link="w"/><child link="f"/><origin xyz="0 0 -0.05"/>'
        '<limit lower="0" upper="1"/></joint></robot>'
    )
    mapping = THUMB.format(joints='"j"', tip='link = "f", offset_m = [0, 0, -0.04]')
    for old in ("j0", "j1", "j2"):
        mapping = mapping.replace(f'"{old}"', '"j"')
    hand = load_hand(*write_hand(tmp_path, text, mapping))
    points = hand.chain_points_m(np.array([[0.5]]))[0, 0]
    np.testing.assert_allclose(points[:3], [[0, 0, -0.05]] * 3, atol=1e-17)
    # URDF's default axis is x.
    np.testing.assert_allclose(
        points[3], [0, 0.04 * np.sin(0.5), -0.05 - 0.04 * np.cos(0.5)], rtol=0, atol=1e-16
    )
