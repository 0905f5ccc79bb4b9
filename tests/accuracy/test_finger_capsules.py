"""The capsules that teleoperation keeps apart, against the meshes of the maker's own hand."""

import sys
from itertools import product

import mujoco
import numpy as np
import pytest

from services.pipelines.teleoperation.finger_gaps import FingerGaps
from services.twin.hands import twin_hand
from tests.unit.hands.hand_texts import official_model
from tests.unit.hands.mujoco_chains import MujocoChains

FINGERS = ("thumb", "index_finger", "middle_finger", "ring_finger", "pinky")
LINKS = ("proximal_abd", "middle", "distal")
# Of meshes further apart MuJoCo says no distance.
FAR_M = 0.05


def mesh_gap_m(model, data, first, second):
    """Distance of the meshes of two fingers; negative where they overlap."""
    return min(
        mujoco.mj_geomDistance(model, data, a, b, FAR_M, None) for a, b in product(first, second)
    )


@pytest.mark.long
def test_capsules_are_as_far_apart_as_the_makers_meshes(capsys):
    model = mujoco.MjModel.from_xml_path(str(official_model("right")))
    chains = MujocoChains(model, "r_wrist", np.eye(3))
    bodies = [model.body(model.geom_bodyid[geom]).name for geom in range(model.ngeom)]
    meshes = [
        [g for g in range(model.ngeom) if model.geom_contype[g] and bodies[g] in names]
        for names in ({f"r_{finger}_{link}" for link in LINKS} for finger in FINGERS)
    ]
    assert [len(each) for each in meshes] == [3] * 5
    twin = twin_hand("right", "robot")
    hand, gaps = twin.kinematics, FingerGaps(twin.kinematics, np.array(twin.shape.radii_m))
    rng = np.random.default_rng(1)
    found = []
    for joints in rng.uniform(hand.lower_rad, hand.upper_rad, (3000, 20)):
        gap_m = gaps.gaps_m(joints[None])[0]
        near = np.flatnonzero((gap_m >= 0) & (gap_m < 0.006))
        if near.size:
            chains.pose(hand.joint_names, joints)
        for pair in near:
            first, second = gaps.pairs[pair]
            mesh_m = mesh_gap_m(model, chains.data, meshes[first], meshes[second])
            found.append((gap_m[pair], mesh_m))
    capsule_mm, mesh_mm = 1e3 * np.array(found).T
    touching, apart = mesh_mm[capsule_mm < 1], mesh_mm[capsule_mm >= 4]
    with capsys.disabled():
        sys.stdout.write(
            f"\ncapsules 0 … 1 mm apart ({len(touching)} pairs): meshes {np.median(touching):.1f} "
            f"mm, 5 % below {np.percentile(touching, 5):.1f}, least {touching.min():.1f}; "
            f"4 … 6 mm apart ({len(apart)}): least {apart.min():.1f} mm\n"
        )
    assert abs(np.median(touching)) < 1.0
    assert touching.min() > -4.0
    assert apart.min() > -0.5
