"""Retargeting of people whose hinges turn about other axes than the robot's.

The robot cannot take every posture of such a hand; how far its bones then point off is bounded, and
is less than with the other libraries where they are installed.
"""

import sys

import numpy as np
import pytest

from benchmarks.retargeting.compare import scale_of, score_bones
from benchmarks.retargeting.rival_process import RivalProcess
from benchmarks.retargeting.rivals import RIVALS, missing_modules
from benchmarks.simulated.hand_motions import oblique_motion
from dextouch.hands.robot_hand import RobotHand
from services.alignment.retargeting import HandRetargeter, RetargetStatus

NUM_SAMPLES = 120


def motions(oblique_deg):
    return [
        oblique_motion(side, oblique_deg, NUM_SAMPLES, seed)
        for side in ("left", "right")
        for seed in range(3)
    ]


def text(score):
    return (
        f"thumb {score.thumb_mean_deg:.2f} (95 %: {score.thumb_p95_deg:.1f}), fingers "
        f"{score.fingers_mean_deg:.2f} ({score.fingers_p95_deg:.1f}) deg"
    )


def joints_of(motion, *, live):
    retargeter = HandRetargeter(motion.side)
    if live:
        steps = [retargeter.step(sample) for sample in motion.keypoints_m]
        return np.concatenate([one.joints_rad for one in steps])
    result, robot = retargeter.retarget(motion.keypoints_m), RobotHand(motion.side)
    assert (result.joints_rad >= robot.lower_rad).all()
    assert (result.joints_rad <= robot.upper_rad).all()
    assert (result.status == RetargetStatus.SOLVED).mean() > 0.9
    return result.joints_rad


# Degrees off the robot's axes; bounds of the means of the thumb's bones and of the fingers'.
@pytest.mark.parametrize(
    ("oblique_deg", "thumb_deg", "fingers_deg"),
    [(0.0, 2.3, 3.3), (5.0, 3.9, 4.0), (10.0, 6.2, 6.2), (15.0, 8.6, 8.0)],
)
def test_bones_point_as_the_persons(oblique_deg, thumb_deg, fingers_deg, capsys):
    people = motions(oblique_deg)
    for live in (False, True):
        score = score_bones(people, [joints_of(one, live=live) for one in people])
        with capsys.disabled():
            sys.stdout.write(
                f"\naxes {oblique_deg:4.1f} deg off, {'live' if live else 'batch':5s}: "
                f"{text(score)}, bounds {thumb_deg}, {fingers_deg}"
            )
        assert score.thumb_mean_deg <= thumb_deg
        assert score.fingers_mean_deg <= fingers_deg


@pytest.mark.slow
@pytest.mark.parametrize("name", RIVALS)
def test_other_libraries_are_further_off(name, capsys):
    if missing_modules(RIVALS[name]):
        pytest.skip(f"{name} is not installed")
    people = motions(10.0)
    with RivalProcess(RIVALS[name]) as rival:
        theirs = score_bones(people, [rival.run(one, scale_of(one)).joints_rad for one in people])
    ours = score_bones(people, [joints_of(one, live=False) for one in people])
    with capsys.disabled():
        sys.stdout.write(f"\n{name}: {text(theirs)} | ours: {text(ours)}")
    assert ours.thumb_mean_deg < theirs.thumb_mean_deg
    assert ours.fingers_mean_deg < theirs.fingers_mean_deg
