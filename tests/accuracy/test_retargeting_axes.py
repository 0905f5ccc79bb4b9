"""Retargeting of people whose hinges turn about other axes than the robot's.

The axes of interphalangeal joints are oblique by up to about 14°, and those of the thumb's saddle
are neither perpendicular nor do they meet (Hollister et al., J. Orthop. Res. 1992). The robot
cannot take every posture of such a hand; how far its bones then point off is bounded.
"""

import sys

import numpy as np
import pytest

from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import CHAINS, NODE_INDEX, NUM_KEYPOINTS, solver_indices
from dextouch.hands.robot_hand import HandModel, RobotHand
from services.alignment.retargeting import HandRetargeter, RetargetStatus
from services.twin.hands import METACARPAL_BASES_M, human_fingers

SADDLE_OFFSET_M = 0.003
NUM_STEPS = 120


def person(side, oblique_deg, seed):
    """A human hand with every axis tilted at random by this angle, and apart in the saddle."""
    rng = np.random.default_rng(seed)

    def tilted(row):
        across = np.cross(row.axis, rng.normal(size=3))
        across *= np.deg2rad(oblique_deg) / np.linalg.norm(across)
        axis = rotation_from_vector(across) @ np.array(row.axis)
        return row._replace(axis=tuple((axis / np.linalg.norm(axis)).tolist()))

    fingers = []
    for finger in human_fingers(side):
        rows = [tilted(row) for row in finger.joints]
        if finger.chain == "thumb" and oblique_deg:
            apart = SADDLE_OFFSET_M * rng.normal(size=3) / np.sqrt(3)
            rows[1] = rows[1]._replace(position_m=tuple(apart.tolist()))
        fingers.append(finger._replace(joints=tuple(rows)))
    return HandModel(side, fingers, name="person")


def gestures(hand, seed):
    """Smooth joint angles [T, 20] of everyday range: fingers bend from straight to 85 %."""
    rng = np.random.default_rng(seed)
    bends = np.tile([True, False, True, True], 5)
    low = np.where(bends, 0.05 * hand.upper_rad, 0.4 * hand.lower_rad)
    high = np.where(bends, 0.85 * hand.upper_rad, 0.4 * hand.upper_rad)
    t_s = np.arange(NUM_STEPS)[:, None] / 60
    waves = np.sin(2 * np.pi * (rng.uniform(0.15, 1.0, 20) * t_s + rng.random(20)))
    return low + (high - low) * (0.5 + 0.5 * waves)


def keypoints_of(hand, joints_rad):
    """The 25 tracked nodes, m, in wrist axes."""
    points = np.zeros((len(joints_rad), NUM_KEYPOINTS, 3))
    chains = hand.chain_points_m(joints_rad)
    for finger, chain in enumerate(CHAINS):
        points[:, solver_indices(chain)] = chains[:, finger]
    mirror = np.array([1.0, 1.0 if hand.side == "right" else -1.0, 1.0])
    for chain, base_m in METACARPAL_BASES_M.items():
        points[:, NODE_INDEX[chain, "metacarpal"]] = base_m * mirror
    return points


def bone_angles_deg(keypoints_m, side, joints_rad):
    """[T, 5, 3]: angle between each of the person's bones and the robot's."""
    person_bones = np.stack(
        [np.diff(keypoints_m[:, solver_indices(chain)], axis=1) for chain in CHAINS], axis=1
    )
    robot_bones = np.diff(RobotHand(side).chain_points_m(joints_rad), axis=2)
    a, b = (
        bones / np.linalg.norm(bones, axis=-1, keepdims=True)
        for bones in (person_bones, robot_bones)
    )
    return np.rad2deg(np.arccos(np.clip((a * b).sum(axis=-1), -1.0, 1.0)))


# Degrees off the robot's axes; bounds of the mean and of 95 % of all bones.
@pytest.mark.parametrize(
    ("oblique_deg", "mean_deg", "most_deg"), [(0.0, 4.0, 11.0), (6.0, 4.0, 11.5), (14.0, 6.5, 18.0)]
)
def test_bones_point_as_the_persons(oblique_deg, mean_deg, most_deg, capsys):
    angles = []
    for seed, side in enumerate(("left", "right")):
        hand, robot = person(side, oblique_deg, seed), RobotHand(side)
        keypoints_m = keypoints_of(hand, gestures(hand, seed))
        result = HandRetargeter(side).retarget(keypoints_m, t_s=np.arange(NUM_STEPS) / 60)
        assert (result.joints_rad >= robot.lower_rad).all()
        assert (result.joints_rad <= robot.upper_rad).all()
        assert (result.status == RetargetStatus.SOLVED).mean() > 0.9
        angles.append(bone_angles_deg(keypoints_m, side, result.joints_rad))
    mean, most = np.mean(angles), np.percentile(angles, 95)
    with capsys.disabled():
        sys.stdout.write(
            f"\naxes {oblique_deg:4.1f} deg off: bones mean {mean:.2f} deg, bound {mean_deg} | "
            f"95 % {most:.2f} deg, bound {most_deg}"
        )
    assert mean <= mean_deg
    assert most <= most_deg
