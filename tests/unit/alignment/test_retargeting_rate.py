"""How far a joint goes from one output to the next: never further than a motor may be asked to."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, ShapeError
from services.alignment.retargeting import HandRetargeter, RetargetOptions, RetargetStatus
from tests.unit.alignment.test_retargeting import EXACT, HAND, NUM_KEYPOINTS, keypoints_of

# 9.6 rad/s at 60 Hz; and the most of a call that is late, as at 30 Hz.
STEP_RAD = 0.16
LATE_STEP_RAD = 0.32
LOST = np.full((NUM_KEYPOINTS, 3), np.nan)
# All joints but those of abduction from 0.1 to 0.9 rad: 5 steps of 0.16 rad.
BENDS = np.arange(20) % 4 != 1
POSTURES = np.where(BENDS, np.array([[0.1], [0.9]]), 0.1)
THERE = keypoints_of(POSTURES)
NUM_STEPS = 5


def follow(live, samples, elapsed_s=1 / 60):
    results = [live.step(sample, elapsed_s=elapsed_s) for sample in samples]
    joints_rad = np.concatenate([one.joints_rad for one in results])
    return joints_rad, np.array([one.status[0] for one in results])


@pytest.fixture(params=["measured", "unknown"])
def live(request):
    profile = None
    if request.param == "measured":
        bends = 0.1 + 0.45 * np.random.default_rng(2).random((60, 20))
        profile = HandRetargeter("right").measure(keypoints_of(bends))
    return HandRetargeter("right", profile, EXACT)


@pytest.mark.parametrize("num_lost", [1, 2, 5, 6, 7, 20, 90])
def test_a_hand_that_was_lost_is_caught_up_with_at_the_limit(live, num_lost):
    samples = [THERE[0], *[LOST] * num_lost, *[THERE[1]] * (NUM_STEPS + 2)]
    joints, status = follow(live, samples)
    steps = np.abs(np.diff(joints, axis=0))
    assert steps.max() <= STEP_RAD + 1e-9
    back = 1 + num_lost
    np.testing.assert_array_equal(joints[1:back], joints[:1].repeat(num_lost, axis=0))
    # As fast as it may: 0.16 rad in every one of the samples until it is there.
    np.testing.assert_allclose(steps[back - 1 : back + NUM_STEPS - 2, BENDS], STEP_RAD, atol=1e-6)
    np.testing.assert_allclose(joints[-1], POSTURES[1], atol=1e-6)
    assert (status[back : back + NUM_STEPS - 1] == RetargetStatus.REACQUIRED).all()
    assert status[-1] == RetargetStatus.SOLVED


def test_a_late_call_may_go_no_further_than_at_30_hz(live):
    joints, status = follow(live, [THERE[0], THERE[1]], elapsed_s=2.0)
    assert np.abs(np.diff(joints, axis=0)).max() == pytest.approx(LATE_STEP_RAD)
    assert status[1] == RetargetStatus.REACQUIRED


def test_the_step_is_an_option():
    live = HandRetargeter("right", options=RetargetOptions(max_step_rad=0.05))
    joints, _ = follow(live, [THERE[0], LOST, *[THERE[1]] * 4])
    assert np.abs(np.diff(joints, axis=0)).max() == pytest.approx(0.05)
    with pytest.raises(InvalidInputError, match="max_step_rad 0"):
        RetargetOptions(max_step_rad=0.0)


def test_what_was_sent_before_the_hand_was_seen_counts(live):
    rest, _ = follow(live, [LOST])
    joints, _ = follow(live, [THERE[1]])
    assert np.abs(joints - rest).max() == pytest.approx(STEP_RAD)


def test_motors_are_started_from_where_they_stand(live):
    live.reset(np.full(20, 0.1))
    joints, status = follow(live, [THERE[1]] * (NUM_STEPS + 1))
    np.testing.assert_allclose(joints[0, BENDS], 0.1 + STEP_RAD, atol=1e-9)
    np.testing.assert_allclose(joints[-1], POSTURES[1], atol=1e-6)
    assert status[0] == RetargetStatus.REACQUIRED
    with pytest.raises(ShapeError, match="joints_rad"):
        live.reset(np.zeros(5))
    with pytest.raises(InvalidInputError, match="joints_rad"):
        live.reset(np.full(20, np.nan))


def test_a_recording_is_bridged_within_the_limit():
    # Uneven times: what is lost lies between samples 3 ms and 30 ms apart.
    elapsed_s = np.tile([0.003, 0.030], 12)
    times_s = np.concatenate([[0.0], np.cumsum(elapsed_s)])
    samples = THERE[[0] * 10 + [1] * 15]
    samples[5:15] = np.nan
    result = HandRetargeter("right", options=EXACT).retarget(samples, t_s=times_s)
    rates = np.abs(np.diff(result.joints_rad, axis=0)) / elapsed_s[:, None]
    assert rates.max() <= 9.6 + 1e-6
    np.testing.assert_allclose(result.joints_rad[-1], POSTURES[1], atol=1e-6)
    assert (result.joints_rad <= HAND.upper_rad).all()
