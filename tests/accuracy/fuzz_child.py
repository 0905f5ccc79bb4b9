"""A process without shape checks: fuzzed samples through the live retargeter, figures as JSON."""

import json
import sys
import time

import numpy as np

from benchmarks.simulated.hand_motions import (
    FAULTS,
    Motion,
    fuzzed,
    people,
    pinch_motion,
    robot_motion,
)
from services.alignment.retargeting import HandRetargeter, RetargetStatus, warm_up

# Of the robot, swaps of neighbours go untold for up to 8 samples; at the velocity limit as many
# bring the joints back, and then the pull of the samples before has to fade.
GOOD_AGAIN = {"human": 5, "robot": 14}


def clean_motion(which, num_samples, seed):
    if which == "robot":
        return robot_motion("right", num_samples, seed, natural=True)
    person = people("left", seed)[0]
    motion = pinch_motion(person, "left")
    # There and back again, as often as it takes.
    rows = np.concatenate([np.arange(len(motion)), np.arange(len(motion))[::-1]])
    rows = np.resize(rows, num_samples)
    return Motion("left", motion.joints_rad[rows], motion.keypoints_m[rows], motion.tips_m[rows])


def follow(retargeter, keypoints_m):
    """Joints, finger status, tip error and processor time (ns) of every sample, one by one."""
    num = len(keypoints_m)
    joints, status = np.empty((num, 20)), np.empty((num, 5), dtype=np.uint8)
    errors_m, spent_ns = np.empty((num, 5)), np.empty(num, dtype=np.int64)
    for index, sample in enumerate(keypoints_m):
        began = time.thread_time_ns()
        result = retargeter.step(sample)
        spent_ns[index] = time.thread_time_ns() - began
        joints[index], status[index] = result.joints_rad[0], result.finger_status[0]
        errors_m[index] = result.tip_error_m[0]
    return joints, status, errors_m, spent_ns


def main(which, num_samples, seed):
    warm_up()
    motion = clean_motion(which, num_samples, seed)
    fuzz = fuzzed(motion, np.random.default_rng(seed))
    retargeter = HandRetargeter(motion.side)
    retargeter = HandRetargeter(motion.side, retargeter.measure(motion.keypoints_m))
    clean, clean_status, _, _ = follow(retargeter, motion.keypoints_m)
    retargeter.reset()
    joints, status, errors_m, spent_ns = follow(retargeter, fuzz.keypoints_m)
    hand = retargeter.hand
    # On the way back at the rate limit, as its status says, a hand is not yet where it is tracked.
    on_the_way = (status == RetargetStatus.REACQUIRED).any(axis=1)
    back = (fuzz.since_fault >= GOOD_AGAIN[which]) & ~on_the_way
    apart_deg = np.rad2deg(np.abs(joints - clean))
    apart_mm = 1e3 * np.linalg.norm(hand.fingertips_m(joints) - hand.fingertips_m(clean), axis=-1)
    # A finger whose own points were changed must not be called solved; one whose were not, must.
    untold = fuzz.hit & (status <= RetargetStatus.SOLVED)
    wronged = ~fuzz.hit & (status >= RetargetStatus.IMPLAUSIBLE)
    figures = {
        "num_samples": num_samples,
        "good_again": GOOD_AGAIN[which],
        "finite": bool(np.isfinite(joints).all() and np.isfinite(errors_m).all()),
        "outside": int(((joints < hand.lower_rad) | (joints > hand.upper_rad)).sum()),
        "clean_unsolved": int((clean_status != RetargetStatus.SOLVED).sum()),
        "worst_ms": float(spent_ns.max() / 1e6),
        "over_1_ms": int((spent_ns > 1_000_000).sum()),
        "median_us": float(np.median(spent_ns) / 1e3),
        "p999_us": float(np.percentile(spent_ns, 99.9) / 1e3),
        "way_back": int(fuzz.since_fault[on_the_way].max()),
        "max_step_rad": float(np.abs(np.diff(joints, axis=0)).max()),
        "back_tip_mm": float(apart_mm[back].max()),
        "back_joint_deg": float(apart_deg[back].max()),
        "back_joint_p999_deg": float(np.percentile(apart_deg[back], 99.9)),
        "num_wronged": int(wronged.sum()),
        "num_unconverged": int((status == RetargetStatus.UNCONVERGED).sum()),
        "kinds": {
            name: {
                "hit": int(fuzz.hit[fuzz.kind == index].sum()),
                "untold": int(untold[fuzz.kind == index].sum()),
            }
            for index, name in enumerate(FAULTS)
        },
    }
    sys.stdout.write(json.dumps(figures))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
