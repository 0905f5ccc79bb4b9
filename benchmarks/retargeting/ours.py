"""Our retargeting solver under the benchmark: live sample by sample, and in batch."""

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from benchmarks.simulated.hand_motions import Motion, cold_postures, motion_of, robot_motion
from services.alignment.retargeting import RetargetOptions
from services.alignment.retargeting.hand_retargeter import HandProfile, HandRetargeter
from services.twin.hands import twin_hand

OURS = "ours"
OURS_LIVE = "ours, live"
OURS_EXACT = "ours, exact"
# A finger counts as solved if its tip error is below this.
FOUND_M = 1e-4


class Timed(NamedTuple):
    """Joint angles [T, 20], processor time of all samples, wall time of each sample's own call."""

    joints_rad: Float64[np.ndarray, "time 20"]
    cpu_s: float
    call_s: Float64[np.ndarray, " calls"]


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
