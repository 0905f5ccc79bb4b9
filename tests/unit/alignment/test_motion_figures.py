"""Speed, jerk and rest of motions that are known in closed form."""

import numpy as np
import pytest

from dextouch.hands.actions import HandTrajectory
from services.alignment.synchronization.grid_actions import motion_figures

RATE_HZ = 100.0


def trajectory(left_m, right_m, joints_rad=None):
    count = len(left_m)
    joints_rad = np.zeros((count, 20)) if joints_rad is None else joints_rad
    wrists = np.tile(np.eye(4), (2, count, 1, 1))
    wrists[0, :, :3, 3], wrists[1, :, :3, 3] = left_m, right_m
    head = np.tile(np.eye(4), (count, 1, 1))
    return HandTrajectory(*wrists, joints_rad, np.zeros((count, 20)), head)


def test_a_wrist_that_swings():
    """x = A sin(ωt): speed up to Aω; the 95th percentile of the jerk is Aω³ cos(0.05 π/2)."""
    t_s = np.arange(2000) / RATE_HZ
    amplitude_m, omega = 0.1, 2 * np.pi * 0.5
    swinging = np.zeros((2000, 3))
    swinging[:, 1] = amplitude_m * np.sin(omega * t_s)
    figures = motion_figures(trajectory(swinging, np.ones((2000, 3))), rate_hz=RATE_HZ)
    assert figures["wrist_left_peak_speed_m_s"] == pytest.approx(amplitude_m * omega, rel=1e-3)
    jerk = amplitude_m * omega**3 * np.cos(0.05 * np.pi / 2)
    assert figures["wrist_left_jerk_p95_m_s3"] == pytest.approx(jerk, rel=5e-3)
    assert figures["wrist_right_peak_speed_m_s"] == 0.0
    assert figures["wrist_right_jerk_p95_m_s3"] == 0.0


def test_hands_at_rest_for_a_while():
    still = np.ones((101, 3))
    moving = still.copy()
    # 25 of 100 intervals at 1 cm each: 1 m/s.
    moving[:26, 0] += np.arange(26) * 0.01
    moving[26:, 0] += 0.25
    assert motion_figures(trajectory(still, moving), rate_hz=RATE_HZ)["static_share"] == 0.75
    # A finger that turns during 10 others.
    joints_rad = np.zeros((101, 20))
    joints_rad[60:, 7] = np.minimum(np.arange(41), 10) * 0.01
    both = motion_figures(trajectory(still, moving, joints_rad), rate_hz=RATE_HZ)
    assert both["static_share"] == pytest.approx(0.65)


def test_noise_of_tracking_is_rest():
    noise_m = np.random.default_rng(0).normal(0, 2e-5, (500, 3))
    assert motion_figures(trajectory(noise_m, noise_m), rate_hz=RATE_HZ)["static_share"] == 1.0


@pytest.mark.parametrize(("count", "num_figures"), [(1, 0), (2, 3), (4, 5)])
def test_short_motions_have_fewer_figures(count, num_figures):
    still = np.zeros((count, 3))
    assert len(motion_figures(trajectory(still, still), rate_hz=RATE_HZ)) == num_figures
