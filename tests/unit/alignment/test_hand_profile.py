"""What stays the same of a person's hand: measured, written down, read again, refused."""

import numpy as np
import pytest

from benchmarks.retargeting.pinches import people, pinch_motion
from benchmarks.simulated.hand_motions import robot_motion
from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands import CHAINS, NODE_INDEX
from services.alignment.retargeting import HandProfile, HandRetargeter
from services.alignment.retargeting.hand_profile import calibrated_profile, profile_name

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


def test_another_persons_hand_is_not_followed(pinches):
    _, motion = pinches
    profile = measured(motion)
    rows = profile.to_rows()
    rows[CHAINS.index("ring"), 3:6] += 0.03
    with pytest.raises(InvalidInputError, match="ring followed in no sample"):
        HandRetargeter("right", HandProfile.from_rows(rows.tolist())).retarget(motion.keypoints_m)
