"""Comparison of retargeting methods on the same motions: errors, and interleaved times.

A library that does not finish has no score or speed; results of the others are kept.
"""

import gc
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.figures import Figure
from benchmarks.retargeting import ours
from benchmarks.retargeting.ours import OURS, OURS_EXACT, OURS_LIVE, Timed
from benchmarks.retargeting.pinches import PinchMotion, pinch_motions
from benchmarks.retargeting.rival_process import RivalProcess
from benchmarks.retargeting.scores import (
    BoneScore,
    PinchScore,
    RobotScore,
    score_bones,
    score_pinches,
    score_robot,
)
from benchmarks.rounds import interleaved
from benchmarks.simulated.hand_motions import Motion, robot_motion, with_noise
from benchmarks.simulated.oblique_people import oblique_motion
from benchmarks.stages import Bar
from dextouch.errors import LimitExceededError
from dextouch.hands.robot_hand import RobotHand
from dextouch.tactile.layout import Side
from services.alignment.retargeting.hand_retargeter import robot_bone_m, warm_up

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


def compare_robot(sets: Mapping[str, Sequence[Motion]], rivals: Rivals, bar: Bar) -> RobotScores:
    """Every method on every set: set → method → score."""
    names = [OURS, OURS_EXACT, *rivals]
    scores: RobotScores = {name: {} for name in sets}
    with bar("robot motions", len(names) * len(sets)) as step:
        for set_name, motions in sets.items():
            for name in names:
                step(f"{set_name}, {name}")
                with suppress(LimitExceededError):
                    answers = [_answer(name, motion, rivals) for motion in motions]
                    scores[set_name][name] = score_robot(motions, answers)
    return scores


def compare_pinches(
    motions: Sequence[PinchMotion], rivals: Rivals, bar: Bar
) -> dict[str, PinchScore]:
    """Every method on people's pinches."""
    names = [OURS, *rivals]
    scores = {}
    with bar("pinches", len(names)) as step:
        for name in names:
            step(name)
            with suppress(LimitExceededError):
                answers = [_answer(name, motion, rivals) for motion in motions]
                scores[name] = score_pinches(motions, answers)
    return scores


def compare_axes(effort: Effort, rivals: Rivals, bar: Bar) -> dict[float, dict[str, BoneScore]]:
    """Every method on gestures of people with other axes than the robot's: degrees → method."""
    names = [OURS, *rivals]
    scores: dict[float, dict[str, BoneScore]] = {}
    with bar("oblique axes", len(names) * len(OBLIQUE_DEG)) as step:
        for oblique_deg in OBLIQUE_DEG:
            motions: list[Motion] = [
                oblique_motion(side, oblique_deg, effort.num_samples, effort.seed + index)
                for side in SIDES
                for index in range(effort.num_people)
            ]
            scores[oblique_deg] = {}
            for name in names:
                step(f"{oblique_deg:g} degrees, {name}")
                with suppress(LimitExceededError):
                    answers = [_answer(name, motion, rivals) for motion in motions]
                    scores[oblique_deg][name] = score_bones(motions, answers)
    return scores


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
    tracked_m = ours.profile_of(motion).bone_m.sum()
    return float(robot_bone_m(RobotHand(motion.side)).sum() / tracked_m)


def _answer(name: str, motion: Motion, rivals: Rivals) -> np.ndarray:
    if name in rivals:
        return rivals[name].run(motion, scale_of(motion)).joints_rad
    return ours.answer(name, motion)


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
    profiles = [ours.profile_of(motion) for motion in motions]
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
        OURS: lambda index: ours.time_batch(motions[index], profiles[index]),
        OURS_LIVE: lambda index: ours.time_live(motions[index], profiles[index]),
        **{name: partial(rival, process) for name, process in rivals.items()},
    }


def _speed(method: str, input_name: str, timed: Sequence[Timed]) -> Speed:
    calls_us = np.concatenate([one.call_s for one in timed]) * 1e6
    call_us = None
    if len(calls_us):
        call_us = float(np.median(calls_us)), float(np.percentile(calls_us, 99))
    cpu_us = Figure.of([one.cpu_s * 1e6 / len(one.joints_rad) for one in timed])
    return Speed(method, input_name, cpu_us, call_us)
