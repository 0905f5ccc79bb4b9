"""Behaviour of retargeting methods on lost samples and nodes."""

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.retargeting import ours
from benchmarks.retargeting.compare import Rivals, scale_of
from benchmarks.retargeting.ours import OURS
from benchmarks.retargeting.scores import score_robot
from benchmarks.simulated.hand_motions import Motion, robot_motion, with_dropouts
from benchmarks.stages import Bar
from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.hands import NODE_INDEX

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
        return _describe(motion, ours.answer(name, motion))
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
