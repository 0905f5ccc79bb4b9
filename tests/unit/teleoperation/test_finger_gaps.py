"""Gaps between fingers against points on their surfaces, and movements that keep them."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from benchmarks.simulated.hand_motions import touching
from dextouch.errors import ShapeError
from services.pipelines.teleoperation.finger_gaps import FingerGaps, segment_distances_m
from services.twin.hands import twin_hand

TWIN = twin_hand("right", "robot")
HAND = TWIN.kinematics
RADII = np.array(TWIN.shape.radii_m)
GAPS = FingerGaps(HAND, RADII)
OPEN = np.clip(0.0, HAND.lower_rad, HAND.upper_rad)
# Of points a hundredth of a link apart, at the distances of touching fingers.
SAMPLING_M = 2e-5


def brute_force_gaps_m(joints_rad):
    """Gaps of all pairs of fingers, from points along the links' axes."""
    [points] = HAND.chain_points_m(joints_rad[None])
    share = np.linspace(0, 1, 101)[:, None]
    axes = []
    for finger in range(5):
        for link in range(3):
            start, end = points[finger, link], points[finger, link + 1]
            radius = RADII[finger, link]
            if link == 2:
                end = end - (end - start) / np.linalg.norm(end - start) * radius
            axes.append((finger, start + share * (end - start), radius))
    found = {}
    for (a, p, r), (b, q, s) in combinations(axes, 2):
        if a != b:
            found[a, b] = min(found.get((a, b), np.inf), cdist(p, q).min() - r - s)
    return np.array([found[tuple(pair)] for pair in GAPS.pairs.tolist()])


def test_gaps_are_those_of_points_on_the_axes():
    rng = np.random.default_rng(0)
    joints = rng.uniform(HAND.lower_rad, HAND.upper_rad, (60, 20))
    found = GAPS.gaps_m(joints)
    expected = np.array([brute_force_gaps_m(each) for each in joints])
    assert found.shape == (60, 10)
    assert (found < 0).sum() > 20
    # Points are never nearer than the lines that they are on.
    assert (expected - found).min() > -1e-12
    near = expected < 0.002
    assert (expected - found)[near].max() < SAMPLING_M * 10


@pytest.mark.parametrize(
    ("p", "p_line", "q", "q_line", "distance"),
    [
        ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), 1.0),
        ((0, 0, 0), (1, 0, 0), (3, 0, 0), (1, 0, 0), 2.0),
        ((0, 0, 0), (1, 0, 0), (0.5, -1, 2), (0, 2, 0), 2.0),
        ((0, 0, 0), (1, 0, 0), (2, 1, 0), (0, 5, 0), 2**0.5),
        ((0, 0, 0), (1, 0, 0), (0.5, -1, 0), (0, 2, 0), 0.0),
    ],
    ids=["parallel", "in a line", "crossing above", "ends", "crossing"],
)
def test_distances_of_segments_by_hand(p, p_line, q, q_line, distance):
    given = (np.array(each, dtype=float)[:, None] for each in (p, p_line, q, q_line))
    assert segment_distances_m(*given)[0] == pytest.approx(distance, abs=1e-12)


def test_the_open_hand_and_its_mirror_are_clear():
    left = twin_hand("left", "robot")
    gaps = FingerGaps(left.kinematics, np.array(left.shape.radii_m))
    for each, joints in ((GAPS, OPEN), (gaps, np.zeros(20))):
        assert each.gaps_m(joints[None]).min() > 0.004


def test_random_movements_never_end_with_fingers_that_overlap():
    rng = np.random.default_rng(1)
    joints, wanted = OPEN, OPEN
    num_stopped = 0
    for number in range(150):
        if number % 15 == 0:
            wanted = rng.uniform(HAND.lower_rad, HAND.upper_rad)
        step = np.clip(wanted - joints, -0.16, 0.16)
        moved, stopped = GAPS.limited(joints, step, 0.0)
        assert (np.abs(moved - joints) <= np.abs(step) + 1e-12).all()
        assert brute_force_gaps_m(moved).min() > -1e-9
        num_stopped += stopped.any()
        joints = moved
    assert num_stopped > 30


def test_only_the_fingers_that_would_meet_stop():
    joints, step = OPEN, np.zeros(20)
    # Index and middle abduct towards each other, the little finger bends.
    step[5], step[9], step[18] = 0.3, -0.3, 0.16
    moved, stopped = GAPS.limited(joints, step, 0.0)
    assert stopped.tolist() == [False, True, True, False, False]
    assert moved[18] == pytest.approx(0.16)
    assert touching(TWIN, (joints + step)[None])[0, 1]
    # As near as the eighth of the step allows.
    assert 0 <= GAPS.gaps_m(moved[None]).min() < 0.006
    apart, stopped = GAPS.limited(moved, -step, 0.0)
    assert not stopped.any()
    np.testing.assert_allclose(apart, moved - step)


def test_a_clearance_is_kept_and_a_hand_that_is_nearer_may_open():
    step = np.zeros(20)
    step[5], step[9] = 0.3, -0.3
    near, _ = GAPS.limited(OPEN, step, 0.0)
    far, stopped = GAPS.limited(OPEN, step, 0.004)
    assert stopped[[1, 2]].all()
    assert brute_force_gaps_m(far).min() >= 0.004 - 1e-9
    opened, stopped = GAPS.limited(near, OPEN - near, 0.004)
    assert not stopped.any()
    np.testing.assert_allclose(opened, OPEN, atol=1e-12)


def test_other_radii_are_refused():
    with pytest.raises(ShapeError, match=r"got \[5, 2\], expected \[5, 3\]"):
        FingerGaps(HAND, RADII[:, :2])
