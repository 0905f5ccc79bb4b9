"""Figures of how wrists and fingers move, by which unusual takes are found."""

from collections.abc import Mapping

import numpy as np

from dextouch.hands.actions import HandTrajectory
from dextouch.tactile.layout import SIDES

# Slower than this is at rest: tracking noise of a wrist, and the slightest motion of a finger.
REST_M_S = 0.02
REST_RAD_S = 0.1


def motion_figures(trajectory: HandTrajectory, *, rate_hz: float) -> Mapping[str, float]:
    """Peak speed and jerk of each wrist, and the share of steps in which both hands are at rest.

    The jerk is the 95th percentile of third differences, which a few outliers do not decide.
    """
    figures: dict[str, float] = {}
    moves = np.zeros(max(len(trajectory.joints_left_rad) - 1, 0), dtype=bool)
    for side in SIDES:
        points_m = getattr(trajectory, f"Ts_world_wrist_{side}")[:, :3, 3]
        joints_rad = getattr(trajectory, f"joints_{side}_rad")
        speeds_m_s = np.linalg.norm(np.diff(points_m, axis=0), axis=1) * rate_hz
        turns_rad_s = np.abs(np.diff(joints_rad, axis=0)).max(axis=1, initial=0.0) * rate_hz
        moves |= (speeds_m_s >= REST_M_S) | (turns_rad_s >= REST_RAD_S)
        if len(points_m) > 1:
            figures[f"wrist_{side}_peak_speed_m_s"] = float(speeds_m_s.max())
        if len(points_m) > 3:
            jerks_m_s3 = np.linalg.norm(np.diff(points_m, n=3, axis=0), axis=1) * rate_hz**3
            figures[f"wrist_{side}_jerk_p95_m_s3"] = float(np.percentile(jerks_m_s3, 95))
    if moves.size:
        figures["static_share"] = float(1 - moves.mean())
    return figures
