"""Errors of fingertips, joints and pinches of retargeted motions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from benchmarks.retargeting.pinches import PinchMotion
from benchmarks.simulated.hand_motions import Motion
from dextouch.errors import InvalidInputError, NonFiniteError
from dextouch.hands import CHAINS, solver_indices
from dextouch.hands.robot_hand import RobotHand
from dextouch.tactile.layout import Side

# Other libraries return float32, which may exceed a limit by rounding.
LIMIT_TOLERANCE_RAD = 1e-6


@dataclass(frozen=True)
class RobotScore:
    """Errors in recovering known joint angles of the robot's own hand, pooled over motions.

    Tip errors are distances in the wrist frame, not relative to the knuckle. `num_outside` joint
    angles are beyond their limits, `max_step_deg` is the largest change of a joint between samples.
    """

    tip_mean_mm: float
    tip_p95_mm: float
    tip_max_mm: float
    joint_mean_deg: float
    joint_max_deg: float
    num_outside: int
    max_step_deg: float


@dataclass(frozen=True)
class PinchScore:
    """Quality of people's pinches on the robot hand, pooled over motions.

    Gaps are the distances of the robot's tips where the human ones are less than 3 mm apart,
    `num_pinched` of them; `same_angle_deg` is the mean difference of robot and human joint angles
    over all samples, `max_step_deg` the largest turn of a joint from one sample to the next.
    """

    gap_mean_mm: float
    gap_p95_mm: float
    same_angle_deg: float
    max_step_deg: float
    num_outside: int
    num_pinched: int


@dataclass(frozen=True)
class BoneScore:
    """Angles between bones of people and of the robot, pooled over motions, mean and p95."""

    thumb_mean_deg: float
    thumb_p95_deg: float
    fingers_mean_deg: float
    fingers_p95_deg: float


def bone_angles_deg(
    keypoints_m: np.ndarray, side: Side, joints_rad: np.ndarray
) -> Float64[np.ndarray, "time 5 3"]:
    """Angle between each bone of tracked keypoints [T, 25, 3] and the robot's at angles [T, 20]."""
    points_m = np.asarray(keypoints_m)[:, [solver_indices(chain) for chain in CHAINS]]
    tracked, robot = (
        bones / np.linalg.norm(bones, axis=-1, keepdims=True)
        for bones in (
            np.diff(points_m, axis=2),
            np.diff(RobotHand(side).chain_points_m(joints_rad), axis=2),
        )
    )
    cosines = np.clip((tracked * robot).sum(axis=-1), -1.0, 1.0)
    return np.asarray(np.rad2deg(np.arccos(cosines)))


def score_bones(motions: Sequence[Motion], answers: Sequence[np.ndarray]) -> BoneScore:
    """Score the directions of bones of the answers [T, 20].

    Raises:
        InvalidInputError: no motion, or answers of another length.
        NonFiniteError: an answer holds NaN or infinity.
    """
    _check(motions, answers)
    angles_deg = np.concatenate(
        [
            bone_angles_deg(motion.keypoints_m, motion.side, answer)
            for motion, answer in zip(motions, answers, strict=True)
        ]
    )
    parts = angles_deg[:, 0], angles_deg[:, 1:]
    return BoneScore(*(float(of(part)) for part in parts for of in (np.mean, _p95)))


def _p95(values: np.ndarray) -> float:
    return float(np.percentile(values, 95))


def score_robot(motions: Sequence[Motion], answers: Sequence[np.ndarray]) -> RobotScore:
    """Errors of the answers [T, 20] to motions of the robot's own hand.

    Raises:
        InvalidInputError: no motion, or answers of another length.
        NonFiniteError: an answer holds NaN or infinity.
    """
    _check(motions, answers)
    tips, joints = [], []
    for motion, answer in zip(motions, answers, strict=True):
        reached = RobotHand(motion.side).fingertips_m(answer)
        tips.append(np.linalg.norm(reached - motion.tips_m, axis=-1).ravel() * 1e3)
        joints.append(np.rad2deg(np.abs(answer - motion.joints_rad)).ravel())
    tip_mm, joint_deg = np.concatenate(tips), np.concatenate(joints)
    return RobotScore(
        float(tip_mm.mean()),
        float(np.percentile(tip_mm, 95)),
        float(tip_mm.max()),
        float(joint_deg.mean()),
        float(joint_deg.max()),
        _num_outside(motions, answers),
        max_step_deg(answers),
    )


def score_pinches(motions: Sequence[PinchMotion], answers: Sequence[np.ndarray]) -> PinchScore:
    """Score the answers [T, 20] to motions of pinching people.

    Raises:
        InvalidInputError: no motion, no sample with a pinch, or answers of another length.
        NonFiniteError: an answer holds NaN or infinity.
    """
    _check(motions, answers)
    gaps, angles = [], []
    for motion, answer in zip(motions, answers, strict=True):
        tips = RobotHand(motion.side).fingertips_m(answer)
        gaps_m = np.linalg.norm(tips[:, 1:] - tips[:, :1], axis=-1)
        gaps.append(gaps_m[motion.pinched] * 1e3)
        angles.append(np.rad2deg(np.abs(answer - motion.joints_rad)).ravel())
    gap_mm = np.concatenate(gaps)
    if not gap_mm.size:
        raise InvalidInputError("pinches: no sample of these motions has its tips within 3 mm")
    return PinchScore(
        float(gap_mm.mean()),
        float(np.percentile(gap_mm, 95)),
        float(np.concatenate(angles).mean()),
        max_step_deg(answers),
        _num_outside(motions, answers),
        gap_mm.size,
    )


def max_step_deg(answers: Sequence[np.ndarray]) -> float:
    """The largest joint change from one sample to the next, within each motion."""
    steps = [np.abs(np.diff(answer, axis=0)).max(initial=0.0) for answer in answers]
    return float(np.rad2deg(max(steps)))


def _num_outside(motions: Sequence[Any], answers: Sequence[np.ndarray]) -> int:
    found = 0
    for motion, answer in zip(motions, answers, strict=True):
        hand = RobotHand(motion.side)
        below = answer < hand.lower_rad - LIMIT_TOLERANCE_RAD
        found += int((below | (answer > hand.upper_rad + LIMIT_TOLERANCE_RAD)).sum())
    return found


def _check(motions: Sequence[Motion], answers: Sequence[np.ndarray]) -> None:
    lengths = [len(motion) for motion in motions], [len(answer) for answer in answers]
    if not motions or lengths[0] != lengths[1]:
        raise InvalidInputError(
            f"answers: got {lengths[1]} samples for motions of {lengths[0]}, expected the same"
        )
    for index, answer in enumerate(answers):
        if not np.isfinite(answer).all():
            raise NonFiniteError(f"answer to motion {index}: contains NaN or infinity")
