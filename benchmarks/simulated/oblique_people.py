"""Gestures of people whose joints turn about other axes than the robot's.

The axes of interphalangeal joints are oblique by up to about 14°, and those of the thumb's saddle
are neither perpendicular nor do they meet (Hollister et al., J. Orthop. Res. 1992).
"""

from typing import Final

import numpy as np
from jaxtyping import Float64

from benchmarks.simulated.hand_motions import RATE_HZ, Motion
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import CHAINS, NODE_INDEX, NUM_KEYPOINTS, solver_indices
from dextouch.hands.robot_hand import HandModel, JointRow
from dextouch.tactile.layout import Side
from services.twin.hands import METACARPAL_BASES_M, human_fingers

SADDLE_OFFSET_M: Final = 0.003
FASTEST_HZ: Final = 1.0


def oblique_motion(side: Side, oblique_deg: float, num_samples: int, seed: int) -> Motion:
    """Smooth gestures of everyday range at 60 Hz: fingers bend from straight to 85 %.

    Every axis of the person is tilted in a random direction by `oblique_deg` from the mean hand's,
    and those of the thumb's saddle are apart.
    """
    rng = np.random.default_rng(seed)
    hand = _person(side, oblique_deg, rng)
    joints_rad = _gestures(hand, num_samples, rng)
    chains = hand.chain_points_m(joints_rad)
    keypoints_m = np.zeros((num_samples, NUM_KEYPOINTS, 3))
    for finger, chain in enumerate(CHAINS):
        keypoints_m[:, solver_indices(chain)] = chains[:, finger]
    mirror = np.array([1.0, 1.0 if side == "right" else -1.0, 1.0])
    for chain, base_m in METACARPAL_BASES_M.items():
        keypoints_m[:, NODE_INDEX[chain, "metacarpal"]] = base_m * mirror
    return Motion(side, joints_rad, keypoints_m, chains[:, :, 3])


def _person(side: Side, oblique_deg: float, rng: np.random.Generator) -> HandModel:
    fingers = []
    for finger in human_fingers(side):
        rows = [_tilted(row, oblique_deg, rng) for row in finger.joints]
        if finger.chain == "thumb" and oblique_deg:
            apart = SADDLE_OFFSET_M * rng.normal(size=3) / np.sqrt(3)
            rows[1] = rows[1]._replace(position_m=tuple(apart.tolist()))
        fingers.append(finger._replace(joints=tuple(rows)))
    return HandModel(side, fingers, name="person")


def _tilted(row: JointRow, oblique_deg: float, rng: np.random.Generator) -> JointRow:
    across = np.cross(row.axis, rng.normal(size=3))
    across *= np.deg2rad(oblique_deg) / np.linalg.norm(across)
    axis = rotation_from_vector(across) @ np.array(row.axis)
    return row._replace(axis=tuple((axis / np.linalg.norm(axis)).tolist()))


def _gestures(
    hand: HandModel, num_samples: int, rng: np.random.Generator
) -> Float64[np.ndarray, "time 20"]:
    bends = np.tile([True, False, True, True], len(CHAINS))
    low = np.where(bends, 0.05 * hand.upper_rad, 0.4 * hand.lower_rad)
    high = np.where(bends, 0.85 * hand.upper_rad, 0.4 * hand.upper_rad)
    t_s = np.arange(num_samples)[:, None] / RATE_HZ
    rate_hz = rng.uniform(0.15, FASTEST_HZ, len(low))
    waves = np.sin(2 * np.pi * (rate_hz * t_s + rng.random(len(low))))
    return np.asarray(low + (high - low) * (0.5 + 0.5 * waves))
