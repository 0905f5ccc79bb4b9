"""Keypoints of synthetic hands whose wrist axes are known: of any person, posture and side."""

import numpy as np

from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import CHAINS, chain_indices
from services.twin.hands import HumanHand


def moving_hand(side, rng, num_samples=60):
    """[n, 25, 3] m in wrist axes: every joint at a place of its own, and moving."""
    hand = HumanHand(side)
    low, high = hand.lower_rad, hand.upper_rad
    middle = low + (high - low) * rng.beta(2, 2, (1, 20))
    joints_rad = middle + 0.3 * rng.normal(size=(num_samples, 20))
    return hand.keypoints_m(np.clip(joints_rad, low, high))


def flat_hand(side, rng, num_samples=60):
    """[n, 25, 3] m in wrist axes: still and flat, every joint a few degrees off."""
    hand = HumanHand(side)
    joints_rad = np.repeat(rng.normal(scale=0.04, size=(1, 20)), num_samples, axis=0)
    return hand.keypoints_m(np.clip(joints_rad, hand.lower_rad, hand.upper_rad))


def of_another_person(keypoints_m, rng, *, bones=0.08, lean_rad=0.035, arch_m=2e-3):
    """The same motion with bones of other lengths and another palm, in the same wrist axes.

    Size 0.7 … 1.25; each bone's length by `bones`, each metacarpal's lean and height as told.
    """
    size = rng.uniform(0.7, 1.25)
    changed = keypoints_m.copy()
    for chain in CHAINS:
        nodes = chain_indices(chain)
        for place, (parent, node) in enumerate(zip([0, *nodes[:-1]], nodes, strict=True)):
            bone = (keypoints_m[:, node] - keypoints_m[:, parent]) * size
            bone = bone * (1 + rng.normal(scale=bones))
            if place == 0 or (place == 1 and chain != "thumb"):
                bone = bone @ rotation_from_vector(np.array([0, rng.normal(scale=lean_rad), 0]))
                bone[:, 1] += rng.normal(scale=arch_m) * (0.5 if place == 0 else 1.0)
            changed[:, node] = changed[:, parent] + bone
    return changed


def any_rotation(rng):
    """A rotation [3, 3], all directions alike."""
    q = rng.normal(size=4)
    w, *vector = q / np.linalg.norm(q)
    angle = 2 * np.arccos(np.clip(w, -1, 1))
    return rotation_from_vector(angle * np.array(vector) / np.linalg.norm(vector))
