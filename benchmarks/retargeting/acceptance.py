"""Requirements on retargeting, with measured values and verdicts."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.figures import Requirement, Sense
from benchmarks.retargeting.compare import (
    FULL,
    FULL_NOISE,
    NATURAL,
    NATURAL_NOISE,
    RobotScores,
    Speed,
)
from benchmarks.retargeting.ours import OURS, OURS_EXACT, ColdStart
from benchmarks.retargeting.rivals import DEX, DEXI, VECTOR, Rival
from benchmarks.retargeting.scores import PinchScore, RobotScore
from benchmarks.simulated.hand_motions import RATE_HZ
from services.alignment.retargeting import RetargetOptions

# (library, how many times as fast), each with its vectors from the wrist to 15 points.
PROMISED_SPEED = ((DEX, 150.0), (DEXI, 5.0))
# Tolerance for rounding at the velocity limit.
_ROUNDING_DEG = 1e-6


def requirements(
    speeds: Sequence[Speed],
    robot: RobotScores,
    pinches: Mapping[str, PinchScore],
    cold: ColdStart,
) -> list[Requirement]:
    """Build the table of requirements; some may be unmeasured in this run."""
    return [
        *_speed(speeds),
        *_exactness([robot[name][OURS_EXACT] for name in (NATURAL, FULL)]),
        *_noise([robot[name][OURS] for name in (NATURAL_NOISE, FULL_NOISE)]),
        *_pinches(pinches[OURS]),
        *_limits(robot, pinches[OURS]),
        *_cold(cold),
    ]


def worst_ratio(speeds: Sequence[Speed], ours: str, rival: str) -> float | None:
    """Other library's time relative to ours: median over the rounds, for the worse input."""
    times = {(speed.method, speed.motion): speed.cpu_us for speed in speeds}
    motions = {motion for method, motion in times if method == rival}
    ratios = [times[rival, motion].over(times[ours, motion]).median for motion in motions]
    return min(ratios, default=None)


def velocity_limit_deg() -> float:
    """Maximum joint change between samples under our default velocity limit."""
    return float(np.rad2deg(RetargetOptions().velocity_limit_rad_s / RATE_HZ))


def _speed(speeds: Sequence[Speed]) -> list[Requirement]:
    return [
        Requirement(
            f"{OURS}: times as fast as {Rival(library, VECTOR).name}",
            worst_ratio(speeds, OURS, Rival(library, VECTOR).name),
            "at least",
            bound,
        )
        for library, bound in PROMISED_SPEED
    ]


def _exactness(scores: Sequence[RobotScore]) -> list[Requirement]:
    rows: list[tuple[str, float, Sense, float, str]] = [
        ("tip error, max", max(one.tip_max_mm for one in scores), "at most", 1e-3, "mm"),
        ("joint error, max", max(one.joint_max_deg for one in scores), "at most", 0.01, "deg"),
        ("joints beyond limits", float(sum(one.num_outside for one in scores)), "at most", 0.0, ""),
    ]
    return [Requirement(f"robot motion, {OURS_EXACT}: {row[0]}", *row[1:]) for row in rows]


def _noise(scores: Sequence[RobotScore]) -> list[Requirement]:
    tip_mm = max(one.tip_mean_mm for one in scores)
    joint_deg = max(one.joint_mean_deg for one in scores)
    return [
        Requirement("robot motion, 1 mm noise: tip error, mean", tip_mm, "at most", 1.3, "mm"),
        Requirement(
            "robot motion, 1 mm noise: joint error, mean", joint_deg, "at most", 1.7, "deg"
        ),
    ]


def _pinches(score: PinchScore) -> list[Requirement]:
    rows = (
        ("gap where the human's is below 3 mm, mean", score.gap_mean_mm, 1.5, "mm"),
        ("gap where the human's is below 3 mm, p95", score.gap_p95_mm, 2.5, "mm"),
        ("off the human joint angles, mean", score.same_angle_deg, 5.0, "deg"),
    )
    return [Requirement(f"pinches: {row[0]}", row[1], "at most", *row[2:]) for row in rows]


def _limits(robot: RobotScores, pinches: PinchScore) -> list[Requirement]:
    scores = [found[OURS] for found in robot.values()]
    step_deg = max([score.max_step_deg for score in scores] + [pinches.max_step_deg])
    outside = sum(score.num_outside for score in scores) + pinches.num_outside
    bound_deg = velocity_limit_deg() + _ROUNDING_DEG
    return [
        Requirement("all motions: turn of a joint a sample", step_deg, "at most", bound_deg, "deg"),
        Requirement("all motions: joints beyond limits", float(outside), "at most", 0.0),
    ]


def _cold(cold: ColdStart) -> list[Requirement]:
    once, retried = cold.num_found_once / cold.num_fingers, cold.num_found / cold.num_fingers
    return [
        Requirement("cold start: fingers within 0.1 mm, one start", once, "at least", 0.999),
        Requirement("cold start: fingers within 0.1 mm, retries", retried, "at least", 1.0),
    ]
