"""Kinematics of the simulated hands against the tables they are made from."""

import mujoco
import numpy as np

from dextouch.geometry import apply
from dextouch.hands import NODE_INDEX
from dextouch.hands.robot_hand import RobotHand
from dextouch.tactile.layout import FINGERS
from services.twin.hands import HumanHand, twin_hand
from services.twin.names import DOMAINS
from services.twin.scene import compile_scene
from services.twin.simulation import TactileReader


def test_simulated_hands_are_where_forward_kinematics_says():
    rng = np.random.default_rng(0)
    for domain in DOMAINS:
        scene = compile_scene(domain, objects="", object_names=())
        data = mujoco.MjData(scene.model)
        skin = TactileReader(scene)
        for index, hand in enumerate(scene.hands):
            joints = rng.uniform(hand.kinematics.lower_rad, hand.kinematics.upper_rad)
            data.qpos[scene.wrist_qpos[index]] = [0, 0, 0, 1, 0, 0, 0]
            data.qpos[scene.joint_qpos[index]] = joints
            mujoco.mj_forward(scene.model, data)
            frames = hand.kinematics.joint_frames(joints[None])[0, :, 3]
            local = [hand.tip_skin_m(finger).reshape(16, 3) for finger in range(len(FINGERS))]
            expected = apply(frames, np.stack(local)).reshape(-1, 3)
            pads = [pad for pad in skin._pads if pad.side_index == index]
            taxels = np.concatenate([skin._skin_world_m(data, pad) for pad in pads])
            np.testing.assert_allclose(taxels[:80], expected, atol=1e-6)
            np.testing.assert_allclose(taxels[80:], hand.palm_skin_m().reshape(-1, 3), atol=1e-6)
            tips = hand.kinematics.fingertips_m(joints[None])[0]
            for finger, table, tip in zip(FINGERS, hand.kinematics.fingers, tips, strict=True):
                body = scene.model.body(f"{hand.side}_{finger}_3").id
                seen = data.xpos[body] + data.xmat[body].reshape(3, 3) @ np.array(table.tip_m)
                np.testing.assert_allclose(seen, tip, atol=1e-6)


def test_robot_hands_are_the_robots_tables():
    for side in ("left", "right"):
        kinematics = twin_hand(side, "robot").kinematics
        assert type(kinematics) is RobotHand
        assert kinematics.joint_names == RobotHand(side).joint_names


def test_human_keypoints_sit_at_the_bases_of_bones_of_the_right_length():
    joints = np.random.default_rng(1).uniform(0.0, 0.3, (3, 20))
    points = HumanHand("right").keypoints_m(joints)
    bones = {
        ("index", "metacarpal", "proximal"): 0.06812,
        ("index", "proximal", "intermediate"): 0.03978,
        ("middle", "intermediate", "distal"): 0.02633,
        ("ring", "distal", "tip"): 0.02125,
        ("thumb", "metacarpal", "proximal"): 0.04622,
        ("thumb", "distal", "tip"): 0.02734,
    }
    for (chain, base, end), length_m in bones.items():
        bone = points[:, NODE_INDEX[chain, end]] - points[:, NODE_INDEX[chain, base]]
        np.testing.assert_allclose(np.linalg.norm(bone, axis=1), length_m, atol=1e-9)
    assert (points[:, 0] == 0).all()


def test_left_human_hand_mirrors_the_right_one():
    joints = np.random.default_rng(2).uniform(-0.3, 0.5, (4, 20))
    left, right = HumanHand("left").keypoints_m(joints), HumanHand("right").keypoints_m(joints)
    np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-12)


def test_taxels_run_from_distal_to_proximal_and_from_radial_to_ulnar():
    for side in ("left", "right"):
        hand = twin_hand(side, "robot")
        palm = hand.palm_skin_m()
        assert (np.diff(palm[..., 2], axis=0) > 0).all()
        assert (np.diff(palm[..., 0], axis=1) < 0).all()
        tip = hand.tip_skin_m(1)
        assert (np.diff(tip[..., 2], axis=0) > 0).all()
        assert (np.diff(tip[..., 0], axis=1) < 0).all()
        assert (tip[..., 1] * hand.palm_sign > 0).all()
