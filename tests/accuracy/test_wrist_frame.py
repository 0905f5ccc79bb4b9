"""Wrist frames found from keypoints in random axes against the true ones, left and right."""

import sys

import numpy as np
import pytest

from dextouch.geometry.rotations import vector_from_rotation
from dextouch.hands import METACARPAL_NODES, PALM_NODES
from services.alignment.retargeting.wrist import calibrate_wrist, wrist_frame
from tests.unit.alignment.tracked_hands import (
    any_rotation,
    flat_hand,
    moving_hand,
    of_another_person,
)

NUM_SEEDS = 60
NUM_SAMPLES = 120


def hide_some(keypoints, rng):
    """A fifth of all nodes, other ones in every sample."""
    keypoints[rng.random(keypoints.shape[:2]) < 0.2] = np.nan


def hide_two(keypoints, rng):
    """Two nodes of the palm, always."""
    keypoints[:, rng.choice(PALM_NODES, 2, replace=False)] = np.nan


def hide_metacarpals(keypoints, rng):
    """What trackers of 21 nodes do not have."""
    keypoints[:, METACARPAL_NODES] = np.nan


def hide_none(keypoints, rng):
    pass


# What is found, degrees: median and 95th percentile allowed; of the same hand as the mean one
# only noise is left, of other people also what their palms differ.
CASES = {
    "mean hand, flat": (flat_hand, False, 1e-3, hide_none, (0.2, 0.4)),
    "mean hand, flat, a fifth of all nodes unseen": (flat_hand, False, 1e-3, hide_some, (0.2, 0.5)),
    "mean hand, flat, two palm nodes unseen": (flat_hand, False, 1e-3, hide_two, (0.25, 0.5)),
    "mean hand, flat, 21 nodes": (flat_hand, False, 1e-3, hide_metacarpals, (0.25, 0.5)),
    "mean hand, moving": (moving_hand, False, 1e-3, hide_none, (0.2, 0.4)),
    "other people, flat": (flat_hand, True, 1e-3, hide_none, (4.0, 9.0)),
    "other people, flat, 3 mm noise": (flat_hand, True, 3e-3, hide_none, (4.0, 9.0)),
}


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_wrist_frames_are_found_and_their_sigma_is_honest(name, capsys):
    make, is_other, noise_m, hide, bounds_deg = CASES[name]
    errors_deg, normalised, sigmas_deg = [], [], []
    for seed in range(NUM_SEEDS):
        rng = np.random.default_rng(seed)
        side = ("left", "right")[seed % 2]
        keypoints = make(side, rng, NUM_SAMPLES)
        if is_other:
            keypoints = of_another_person(keypoints, rng)
        keypoints = keypoints + rng.normal(scale=noise_m, size=keypoints.shape)
        hide(keypoints, rng)
        R, offset = any_rotation(rng), rng.normal(size=3)
        find = calibrate_wrist if make is flat_hand else wrist_frame
        frame = find(keypoints @ R.T + offset, side)
        error = vector_from_rotation(R.T @ frame.T_tracker_wrist[:3, :3])
        errors_deg.append(np.rad2deg(np.linalg.norm(error)))
        sigmas_deg.append(np.rad2deg(frame.sigma_rad))
        normalised.append(error @ np.linalg.solve(frame.covariance, error) / 3)
    middle, high = np.percentile(errors_deg, [50, 95])
    nees = float(np.mean(normalised))
    with capsys.disabled():
        sys.stdout.write(
            f"\n{name}, {NUM_SEEDS} hands: median {middle:.2f} deg, bound {bounds_deg[0]} | 95 % "
            f"{high:.2f}, bound {bounds_deg[1]} | sigma {np.median(sigmas_deg):.2f} | NEES "
            f"{nees:.2f}, bounds 0.3 and 2"
        )
    assert middle <= bounds_deg[0]
    assert high <= bounds_deg[1]
    assert 0.3 <= nees <= 2
