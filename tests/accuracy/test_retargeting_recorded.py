"""Retargeting of a real tracked hand: no step after a loss is too large for a motor."""

import sys

import numpy as np
import pytest

from services.alignment.retargeting import HandRetargeter, RetargetStatus
from tests.accuracy.recorded_hand import needs_recording, recorded_keypoints_m

pytestmark = needs_recording
# 9.6 rad/s at 60 Hz: 9.17 degrees.
STEP_RAD = 0.16


@pytest.fixture(scope="module")
def keypoints_m():
    return recorded_keypoints_m()


def live(retargeter, keypoints_m, elapsed_s):
    results = [retargeter.step(sample, elapsed_s=elapsed_s) for sample in keypoints_m]
    return np.concatenate([one.joints_rad for one in results]), results


@pytest.mark.parametrize("is_measured", [True, False])
def test_losses_make_no_jump(keypoints_m, is_measured, capsys):
    rng = np.random.default_rng(7)
    lost = keypoints_m.copy()
    at = 5
    while at < len(lost) - 60:
        length = int(rng.choice([1, 2, 5, 12, 40]))
        lost[at : at + length] = np.nan
        at += length + int(rng.integers(3, 25))
    profile = HandRetargeter("right").measure(keypoints_m) if is_measured else None
    joints, results = live(HandRetargeter("right", profile), lost, 1 / 60)
    steps_deg = np.rad2deg(np.abs(np.diff(joints, axis=0)))
    again = sum(one.status[0] == RetargetStatus.REACQUIRED for one in results)
    with capsys.disabled():
        sys.stdout.write(
            f"\n{np.isnan(lost[:, 0, 0]).sum()} of {len(lost)} samples lost: largest step "
            f"{steps_deg.max():.1f} deg, bound {np.rad2deg(STEP_RAD):.2f}; {again} samples "
            "on their way back\n"
        )
    assert steps_deg.max() <= np.rad2deg(STEP_RAD) + 1e-9
    assert again > 0
