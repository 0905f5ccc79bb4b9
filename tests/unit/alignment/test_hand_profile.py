"""What stays the same of a person's hand: measured, written down, read again, refused."""

import numpy as np
import pytest

from benchmarks.simulated.hand_motions import people, pinch_motion, robot_motion
from dextouch.errors import InvalidInputError, ShapeError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import CHAINS, NODE_INDEX, chain_indices, mean_hand_m
from services.alignment.retargeting import HandProfile, HandRetargeter
from services.alignment.retargeting.hand_retargeter import calibrated_profile, profile_name

NOISE_M = 1e-3


@pytest.fixture(scope="module")
def pinches():
    person = people("right", 2)[1]
    return person, pinch_motion(person, "right")


def measured(motion, noise_m=0.0):
    rng = np.random.default_rng(3)
    keypoints = motion.keypoints_m + rng.normal(scale=noise_m, size=motion.keypoints_m.shape)
    return HandRetargeter(motion.side).measure(keypoints)


def test_bones_and_knuckles_of_a_person(pinches):
    person, motion = pinches
    truth = person.chain_points_m(motion.joints_rad)
    bones = np.linalg.norm(np.diff(truth, axis=2), axis=-1)[0]
    exact, noisy = measured(motion), measured(motion, NOISE_M)
    np.testing.assert_allclose(exact.bone_m, bones, atol=1e-9)
    np.testing.assert_allclose(exact.knuckle_m, truth[0, :, 0], atol=1e-9)
    # Medians of 440 samples; the length of a noisy bone is longer by sigma² / length.
    np.testing.assert_allclose(noisy.bone_m, bones, atol=0.3e-3)
    np.testing.assert_allclose(noisy.knuckle_m, truth[0, :, 0], atol=0.3e-3)
    assert noisy.point_sigma_m == pytest.approx(NOISE_M, rel=0.15)
    # Where fingers turn in place, nothing of the robot's knuckle travel is seen.
    assert noisy.travel.max() <= 0.1
    assert not noisy.is_rigid
    assert noisy.knuckle_sigma_m.min() >= 0.3 * noisy.point_sigma_m


def test_the_robots_own_knuckles_travel():
    profile = measured(robot_motion("left", 600, 1, natural=True))
    np.testing.assert_allclose(profile.travel, 1.0, atol=1e-6)
    assert profile.is_rigid
    # Never zero, which would say that nothing is left to chance.
    np.testing.assert_allclose(profile.knuckle_sigma_m, 1e-5, atol=1e-6)


def test_outliers_do_not_make_bones(pinches):
    _, motion = pinches
    keypoints = motion.keypoints_m.copy()
    keypoints[::5, NODE_INDEX["index", "tip"]] += 0.05
    profile = HandRetargeter("right").measure(keypoints)
    np.testing.assert_allclose(profile.bone_m, measured(motion).bone_m, atol=1e-6)


def test_samples_that_are_no_fingers_tell_nothing_of_knuckles():
    motion = robot_motion("left", 600, 1, natural=True)
    keypoints = motion.keypoints_m.copy()
    # The last bone of a nearly straight joint folded back: its length is right, its bend none that
    # a finger makes.
    rows = np.flatnonzero(motion.joints_rad[:, 7] < 0.6)
    assert 100 < len(rows) < 500
    distal, tip = (keypoints[rows, NODE_INDEX["index", name]] for name in ("distal", "tip"))
    keypoints[rows, NODE_INDEX["index", "tip"]] = 2 * distal - tip
    profile = HandRetargeter("left").measure(keypoints)
    np.testing.assert_allclose(profile.travel, 1.0, atol=1e-6)
    np.testing.assert_allclose(profile.knuckle_sigma_m, 1e-5, atol=1e-6)


def test_profile_goes_through_a_calibration(pinches):
    _, motion = pinches
    profile = measured(motion, NOISE_M)
    rows = tuple(tuple(row) for row in profile.to_rows().tolist())
    read = calibrated_profile({profile_name("right"): rows}, "right")
    np.testing.assert_array_equal(read.to_rows(), profile.to_rows())
    assert calibrated_profile({profile_name("right"): rows}, "left") is None
    same = [HandRetargeter("right", one).retarget(motion.keypoints_m) for one in (profile, read)]
    np.testing.assert_array_equal(same[0].joints_rad, same[1].joints_rad)


def test_what_is_no_hand_is_refused(pinches):
    rows = measured(pinches[1]).to_rows()
    with pytest.raises(ShapeError, match="hand profile"):
        HandProfile.from_rows(rows[:, :8].tolist())
    with pytest.raises(InvalidInputError, match="millimetres"):
        HandProfile.from_rows((rows * 1e3).tolist())
    broken = rows.copy()
    broken[2, 4] = np.nan
    with pytest.raises(InvalidInputError, match="finite"):
        HandProfile.from_rows(broken.tolist())
    broken = rows.copy()
    broken[3, 1] = 0.5
    with pytest.raises(InvalidInputError, match="bones"):
        HandProfile.from_rows(broken.tolist())


@pytest.mark.parametrize("size", [0.55, 0.6, 0.62, 1.5])
def test_the_documented_sizes_of_hands_are_accepted(size):
    """0.55 … 1.5 of the mean hand (docs/hand_frames.md), whose fingers bend here."""
    hand = np.array(mean_hand_m("right"))
    take = []
    for share in np.linspace(0, 1, 60):
        bent = hand.copy()
        for chain in CHAINS[1:]:
            nodes = chain_indices(chain)
            for joint, degrees in enumerate((85, 95, 65)):
                turn = rotation_from_vector(np.deg2rad(degrees * share) * np.array([1.0, 0, 0]))
                node, later = nodes[1 + joint], nodes[2 + joint :]
                bent[later] = (bent[later] - bent[node]) @ turn.T + bent[node]
        take.append(bent)
    noise = np.random.default_rng(0).normal(scale=3e-4, size=(60, len(hand), 3))
    keypoints_m = size * np.array(take) + noise
    result = HandRetargeter("right").retarget(keypoints_m, t_s=np.arange(60) / 60)
    assert result.solved.mean() > 0.9


def test_another_persons_hand_is_not_followed(pinches):
    _, motion = pinches
    profile = measured(motion)
    rows = profile.to_rows()
    rows[CHAINS.index("ring"), 3:6] += 0.03
    with pytest.raises(InvalidInputError, match="ring followed in no sample"):
        HandRetargeter("right", HandProfile.from_rows(rows.tolist())).retarget(motion.keypoints_m)
