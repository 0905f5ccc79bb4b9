"""Comparison of retargeting methods on the same motions: errors, interleaved times, and faults.

A library that does not finish has no score or speed; results of the others are kept.
"""

import gc
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float64

from benchmarks.figures import Figure, interleaved
from benchmarks.retargeting.rival_process import RivalProcess
from benchmarks.retargeting.rivals import Timed
from benchmarks.simulated.hand_motions import (
    Motion,
    PinchMotion,
    cold_postures,
    motion_of,
    oblique_motion,
    pinch_motions,
    robot_motion,
    with_dropouts,
    with_noise,
)
from benchmarks.stages import Bar
from dextouch.errors import InvalidInputError, LimitExceededError, NonFiniteError
from dextouch.hands import CHAINS, NODE_INDEX, solver_indices
from dextouch.hands.robot_hand import RobotHand
from dextouch.tactile.layout import Side
from services.alignment.retargeting import RetargetOptions
from services.alignment.retargeting.hand_retargeter import (
    HandProfile,
    HandRetargeter,
    robot_bone_m,
    warm_up,
)
from services.twin.hands import twin_hand

OURS = "ours"
OURS_LIVE = "ours, live"
OURS_EXACT = "ours, exact"
# A finger counts as solved if its tip error is below this.
FOUND_M = 1e-4


def answer(name: str, motion: Motion) -> Float64[np.ndarray, "time 20"]:
    """Joint angles of a recording of an unknown person; `OURS_EXACT` has no temporal term."""
    options = RetargetOptions(temporal_weight_m2=0.0) if name == OURS_EXACT else RetargetOptions()
    return HandRetargeter(motion.side, options=options).retarget(motion.keypoints_m).joints_rad


def profile_of(motion: Motion) -> HandProfile:
    """Hand profile measured before timing, as the scale is for rivals."""
    return HandRetargeter(motion.side).measure(motion.keypoints_m)


def time_batch(motion: Motion, profile: HandProfile) -> Timed:
    """Time a whole recording with `retarget`."""
    retargeter = HandRetargeter(motion.side, profile)
    begun_s = time.process_time()
    result = retargeter.retarget(motion.keypoints_m)
    return Timed(result.joints_rad, time.process_time() - begun_s, np.empty(0))


def time_live(motion: Motion, profile: HandProfile) -> Timed:
    """Time sample by sample with `step`."""
    retargeter = HandRetargeter(motion.side, profile)
    samples = list(motion.keypoints_m)
    results, calls_ns = [], [time.perf_counter_ns()]
    begun_s = time.process_time()
    for keypoints_m in samples:
        results.append(retargeter.step(keypoints_m))
        calls_ns.append(time.perf_counter_ns())
    cpu_s = time.process_time() - begun_s
    joints = np.concatenate([result.joints_rad for result in results])
    return Timed(joints, cpu_s, np.diff(calls_ns) * 1e-9)


class ColdStart(NamedTuple):
    """Number of fingers in cold starts, and of those solved with one start and with retries."""

    num_fingers: int
    num_found_once: int
    num_found: int


def cold_start(num_postures: int, seed: int) -> ColdStart:
    """Solve independent random postures of both hands within the joint limits."""
    found = {1: 0, RetargetOptions().num_starts: 0}
    num_fingers = 0
    for side in ("left", "right"):
        hand = twin_hand(side, "robot")
        profile = profile_of(robot_motion(side, 240, seed, natural=False))
        postures = cold_postures(side, num_postures, seed)
        num_fingers += postures.tips_m[..., 0].size
        for num_starts in found:
            retargeter = HandRetargeter(side, profile, RetargetOptions(num_starts=num_starts))
            joints = np.concatenate([_alone(retargeter, one) for one in postures.keypoints_m])
            off_m = motion_of(hand, joints).tips_m - postures.tips_m
            found[num_starts] += int((np.linalg.norm(off_m, axis=-1) < FOUND_M).sum())
    once, retried = found.values()
    return ColdStart(num_fingers, once, retried)


def _alone(retargeter: HandRetargeter, keypoints_m: np.ndarray) -> Float64[np.ndarray, "1 20"]:
    retargeter.reset()
    return retargeter.step(keypoints_m).joints_rad


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
    """Score the directions of bones of the answers [T, 20]; raises as `_check`."""
    _check(motions, answers)
    angles_deg = np.concatenate(
        [
            bone_angles_deg(motion.keypoints_m, motion.side, answer)
            for motion, answer in zip(motions, answers, strict=True)
        ]
    )
    parts = angles_deg[:, 0], angles_deg[:, 1:]
    return BoneScore(
        *(float(of(part)) for part in parts for of in (np.mean, partial(np.percentile, q=95)))
    )


def score_robot(motions: Sequence[Motion], answers: Sequence[np.ndarray]) -> RobotScore:
    """Errors of the answers [T, 20] to motions of the robot's own hand; raises as `_check`."""
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

    Raises InvalidInputError if no sample has a pinch, and as `_check`.
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
    """Raise InvalidInputError without motions or for other lengths, NonFiniteError for NaN."""
    lengths = [len(motion) for motion in motions], [len(answer) for answer in answers]
    if not motions or lengths[0] != lengths[1]:
        raise InvalidInputError(
            f"answers: got {lengths[1]} samples for motions of {lengths[0]}, expected the same"
        )
    for index, answer in enumerate(answers):
        if not np.isfinite(answer).all():
            raise NonFiniteError(f"answer to motion {index}: contains NaN or infinity")


SIDES: tuple[Side, Side] = ("left", "right")
NATURAL, FULL = "natural range", "full range"
NATURAL_NOISE, FULL_NOISE = "natural, 1 mm noise", "full, 1 mm noise"
ROBOT_INPUT, PINCH_INPUT = "robot motion", "human pinches"
NOISE_M = 1e-3
_NOISE_STREAM = 7
# Degrees between axes of people and of the mean hand.
OBLIQUE_DEG = (5.0, 10.0, 15.0)


@dataclass(frozen=True)
class Effort:
    """Extent of the measurement.

    Robot motions are `num_seeds` of each kind and side, of `num_samples` at 60 Hz each, as is a
    round of the timing; people per side are 1 … 5, smallest first; `seed` is that of the first
    motion.
    """

    num_seeds: int
    num_samples: int
    num_people: int
    num_rounds: int
    num_postures: int
    seed: int


@dataclass(frozen=True)
class Speed:
    """One method on one input: processor time a sample of each round, wall time of its calls.

    `call_us` are the median and 99th percentile of a call's wall time over all rounds; None where
    there is one call for all samples.
    """

    method: str
    motion: str
    cpu_us: Figure
    call_us: tuple[float, float] | None


Rivals = Mapping[str, RivalProcess]
RobotScores = dict[str, dict[str, RobotScore]]
Score = TypeVar("Score")


def robot_sets(effort: Effort) -> dict[str, list[Motion]]:
    """Motions of the robot's own hands, natural and full range, without and with noise."""
    sets: dict[str, list[Motion]] = {}
    for name, noisy, natural in ((NATURAL, NATURAL_NOISE, True), (FULL, FULL_NOISE, False)):
        sets[name] = [
            robot_motion(side, effort.num_samples, effort.seed + index, natural=natural)
            for side in SIDES
            for index in range(effort.num_seeds)
        ]
        rng = np.random.default_rng([effort.seed, _NOISE_STREAM, int(natural)])
        sets[noisy] = [with_noise(motion, NOISE_M, rng) for motion in sets[name]]
    return sets


def pinch_set(effort: Effort) -> list[PinchMotion]:
    """Pinches of people of several sizes, both sides."""
    motions = {side: pinch_motions(side, effort.seed)[: effort.num_people] for side in SIDES}
    return [motion for side in SIDES for motion in motions[side]]


def compare(
    what: str,
    sets: Mapping[Any, Sequence[Motion]],
    score: Callable[[Any, Sequence[np.ndarray]], Score],
    names: Sequence[str],
    rivals: Rivals,
    bar: Bar,
) -> dict[Any, dict[str, Score]]:
    """Every method on every set of motions: set → method → score."""
    scores: dict[Any, dict[str, Score]] = {key: {} for key in sets}
    with bar(what, len(names) * len(sets)) as step:
        for key, motions in sets.items():
            for name in names:
                step(f"{key}, {name}")
                with suppress(LimitExceededError):
                    answers = [_answer(name, motion, rivals) for motion in motions]
                    scores[key][name] = score(motions, answers)
    return scores


def compare_robot(sets: Mapping[str, Sequence[Motion]], rivals: Rivals, bar: Bar) -> RobotScores:
    """Every method on every set: set → method → score."""
    names = [OURS, OURS_EXACT, *rivals]
    return compare("robot motions", sets, score_robot, names, rivals, bar)


def compare_pinches(
    motions: Sequence[PinchMotion], rivals: Rivals, bar: Bar
) -> dict[str, PinchScore]:
    """Every method on people's pinches."""
    sets = {PINCH_INPUT: motions}
    return compare("pinches", sets, score_pinches, [OURS, *rivals], rivals, bar)[PINCH_INPUT]


def compare_axes(effort: Effort, rivals: Rivals, bar: Bar) -> dict[float, dict[str, BoneScore]]:
    """Every method on gestures of people with other axes than the robot's: degrees → method."""
    sets = {
        oblique_deg: [
            oblique_motion(side, oblique_deg, effort.num_samples, effort.seed + index)
            for side in SIDES
            for index in range(effort.num_people)
        ]
        for oblique_deg in OBLIQUE_DEG
    }
    return compare("oblique axes", sets, score_bones, [OURS, *rivals], rivals, bar)


def compare_speed(effort: Effort, rivals: Rivals, bar: Bar) -> list[Speed]:
    """Every method alternately on the same samples: robot motions and pinches, with noise.

    A round is one hand; sides and seeds (or people) change from round to round. Profiles of the
    person and scales for the other libraries are computed beforehand.
    """
    warm_up()
    found = []
    inputs = {name: _timed_motions(name, effort) for name in (ROBOT_INPUT, PINCH_INPUT)}
    num_subjects = (2 + len(rivals)) * len(inputs)
    with bar("timing", effort.num_rounds * num_subjects) as step:
        for input_name, motions in inputs.items():
            subjects = _subjects(motions, rivals)
            for subject in subjects.values():
                subject(0)
            gc.collect()
            for name, timed in interleaved(subjects, effort.num_rounds, on_step=step).items():
                finished = [one for one in timed if one is not None]
                if len(finished) == len(timed):
                    found.append(_speed(name, input_name, finished))
    return found


def scale_of(motion: Motion) -> float:
    """Ratio of the robot's finger lengths to the tracked ones, the scale given to rivals."""
    tracked_m = profile_of(motion).bone_m.sum()
    return float(robot_bone_m(RobotHand(motion.side)).sum() / tracked_m)


def _answer(name: str, motion: Motion, rivals: Rivals) -> np.ndarray:
    if name in rivals:
        return rivals[name].run(motion, scale_of(motion)).joints_rad
    return answer(name, motion)


def _timed_motions(input_name: str, effort: Effort) -> list[Motion]:
    """One motion a round, with 1 mm of noise."""
    rng = np.random.default_rng([effort.seed, _NOISE_STREAM])
    motions: list[Motion] = []
    for index in range(effort.num_rounds):
        side = SIDES[index % 2]
        if input_name == ROBOT_INPUT:
            seed = effort.seed + index
            motions.append(robot_motion(side, effort.num_samples, seed, natural=True))
        else:
            pinches = pinch_motions(side, effort.seed)
            motions.append(pinches[index % len(pinches)])
    return [with_noise(motion, NOISE_M, rng) for motion in motions]


def _subjects(
    motions: Sequence[Motion], rivals: Rivals
) -> dict[str, Callable[[int], Timed | None]]:
    """Functions that time a method on a motion; they return None once a rival did not finish."""
    profiles = [profile_of(motion) for motion in motions]
    scales = [scale_of(motion) for motion in motions]

    given_up = set()

    def rival(process: RivalProcess, index: int) -> Timed | None:
        name = process.rival.name
        if name not in given_up:
            with suppress(LimitExceededError):
                return process.run(motions[index], scales[index])
            given_up.add(name)
        return None

    return {
        OURS: lambda index: time_batch(motions[index], profiles[index]),
        OURS_LIVE: lambda index: time_live(motions[index], profiles[index]),
        **{name: partial(rival, process) for name, process in rivals.items()},
    }


def _speed(method: str, input_name: str, timed: Sequence[Timed]) -> Speed:
    calls_us = np.concatenate([one.call_s for one in timed]) * 1e6
    call_us = None
    if len(calls_us):
        call_us = float(np.median(calls_us)), float(np.percentile(calls_us, 99))
    cpu_us = Figure.of([one.cpu_s * 1e6 / len(one.joints_rad) for one in timed])
    return Speed(method, input_name, cpu_us, call_us)


NODE_LOST, HAND_LOST, NODES_LOST = "one node lost once", "hand lost once", "2 % of nodes lost"
_NUM_SAMPLES, _LOST_SAMPLE = 60, 30


@dataclass(frozen=True)
class Outcome:
    """Result of one method on one fault."""

    method: str
    fault: str
    text: str


def faulty_motions(seed: int) -> dict[str, Motion]:
    """One motion per fault; lost nodes are NaN, as from trackers."""
    motion = robot_motion("right", _NUM_SAMPLES, seed, natural=True)
    node, hand = motion.keypoints_m.copy(), motion.keypoints_m.copy()
    node[_LOST_SAMPLE, NODE_INDEX["index", "tip"]] = np.nan
    hand[_LOST_SAMPLE] = np.nan
    return {
        NODE_LOST: replace(motion, keypoints_m=node),
        HAND_LOST: replace(motion, keypoints_m=hand),
        NODES_LOST: with_dropouts(motion, 0.02, np.random.default_rng(seed)),
    }


def try_faults(seed: int, rivals: Rivals, bar: Bar) -> list[Outcome]:
    """Run every method on every fault; a hanging call is aborted."""
    names, faults = [OURS, *rivals], faulty_motions(seed)
    whole = robot_motion("right", _NUM_SAMPLES, seed, natural=True)
    outcomes = []
    with bar("faults", len(names) * len(faults)) as step:
        for name in names:
            for fault, motion in faults.items():
                step(f"{name}, {fault}")
                outcomes.append(Outcome(name, fault, _try(name, motion, whole, rivals)))
    return outcomes


def _try(name: str, motion: Motion, whole: Motion, rivals: Rivals) -> str:
    if name not in rivals:
        return _describe(motion, answer(name, motion))
    try:
        joints = rivals[name].run(motion, scale_of(whole)).joints_rad
    except LimitExceededError as error:
        return f"never returned within {error.details['limit_s']:g} s of processor time"
    except InvalidInputError:
        return "refuses the sample"
    return _describe(motion, joints)


def _describe(motion: Motion, joints_rad: np.ndarray) -> str:
    if not np.isfinite(joints_rad).all():
        lost = int((~np.isfinite(joints_rad).all(axis=1)).sum())
        return f"NaN in {lost} of {len(joints_rad)} samples"
    score = score_robot([motion], [joints_rad])
    return f"continues, tips {score.tip_mean_mm:.2g} mm off (worst {score.tip_max_mm:.2g})"
