"""Samples of a tracked hand in, joint angles out: the entry to the compiled code.

Every finger is a small least-squares problem in a box: points of a *virtual hand* (the robot's
axes, the person's bones) against measured points, plus a pull towards the sample before. Thumb and
fingers that come near one another are solved together: vectors between the robot's own fingertips
against the measured ones.
"""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver.apart import push_apart
from services.alignment.retargeting.solver.arrays import (
    IMPLAUSIBLE,
    MISSING,
    NOMINAL_PERIOD_S,
    PARTIAL,
    REACQUIRED,
    UNCONVERGED,
)
from services.alignment.retargeting.solver.compiled import compiled, compiled_once
from services.alignment.retargeting.solver.minimize import minimize, solve_cold
from services.alignment.retargeting.solver.seen import find_pinches, read_sample, see_finger

# How often fingers are pushed apart in one sample.
MAX_PUSHES = 4


@compiled
@no_type_check
def set_box(hand, tuning, work, finger, memory):
    """Where the joints of a finger may go in this sample, and how strongly they are pulled back."""
    unsolved_s = memory.unsolved_s[finger]
    reach = tuning.velocity_limit_rad_s * unsolved_s
    for joint in range(hand.num_joints[finger]):
        now = memory.joints_rad[finger, joint]
        lower, upper = hand.lower_rad[finger, joint], hand.upper_rad[finger, joint]
        if np.isfinite(reach):
            lower, upper = max(lower, now - reach), min(upper, now + reach)
        work.lower[finger, joint] = lower
        work.upper[finger, joint] = upper
        work.before[finger, joint] = now
    is_cold = unsolved_s >= tuning.reacquire_after_s
    work.pull_m2[finger] = (
        0.0 if is_cold else tuning.temporal_weight_m2 * NOMINAL_PERIOD_S / unsolved_s
    )
    return is_cold


@compiled
@no_type_check
def tip_error(work, finger):
    """Distance of the virtual tip from the measured one, both seen from the knuckle if it was."""
    if not work.usable[finger, 3]:
        return 0.0
    squared = 0.0
    for k in range(3):
        error = work.point[finger, 3, k] - work.measured[finger, 3, k]
        if work.usable[finger, 0]:
            error -= work.point[finger, 0, k] - work.measured[finger, 0, k]
        squared += error * error
    return np.sqrt(squared)


@compiled
@no_type_check
def worst_of(status):
    """Of a sample: the worst of its fingers, but PARTIAL while only some are lost."""
    worst, least = 0, MISSING
    for one in status:
        least = min(least, one)
        worst = max(worst, one if one < IMPLAUSIBLE else PARTIAL)
    return worst if least < IMPLAUSIBLE else least


@compiled
@no_type_check
def solve_sample(hand, person, work, joints, num_near, status):
    """The thumb with the fingers near it (`members`), then every other finger alone."""
    for number in range(-1, hand.num_fingers):
        if number < 0:
            group = work.members[:num_near]
            if num_near == 0:
                continue
        else:
            work.members[-1] = number
            group = work.members[-1:]
            is_near = False
            for member in work.members[:num_near]:
                is_near = is_near or member == number
            if is_near or status[number] >= IMPLAUSIBLE:
                continue
        _, at_rest = minimize(hand, person, work, group, joints)
        if not at_rest:
            for finger in group:
                status[finger] = UNCONVERGED


@compiled_once
@no_type_check
def retarget_samples(tables, samples, memory, output):
    """Follow a tracked hand through T samples.

    Args:
        tables: (hand, person, tuning, scratch), records of one element each.
        samples: (keypoints [T, K, 3] m in wrist axes, NaN or infinite where missing; valid bool
            [T, K]; elapsed_s [T], since the sample before).
        memory: `Memory`, of the sample before the first; afterwards of the last.
        output: `Output`, filled.
    """
    keypoints, valid, elapsed_s = samples
    hand, person, tuning, work = tables[0][0], tables[1][0], tables[2][0], tables[3][0]
    num_fingers = hand.num_fingers
    joints = memory.joints_rad
    for t in range(len(keypoints)):
        status = output.finger_status[t]
        read_sample(hand, work, keypoints[t], valid[t])
        for finger in range(num_fingers):
            memory.unsolved_s[finger] += elapsed_s[t]
            status[finger] = see_finger(hand, person, tuning, work, finger)
            if status[finger] < IMPLAUSIBLE and set_box(hand, tuning, work, finger, memory):
                solve_cold(hand, person, work, finger, joints, tuning.num_starts)
                if np.isfinite(memory.unsolved_s[finger]):
                    status[finger] = REACQUIRED
        num_near = find_pinches(hand, tuning, work, status)
        solve_sample(hand, person, work, joints, num_near, status)
        for finger in range(num_fingers):
            is_solved = status[finger] < IMPLAUSIBLE
            output.tip_error_m[t, finger] = tip_error(work, finger) if is_solved else 0.0
            if is_solved:
                memory.unsolved_s[finger] = 0.0
        if tuning.keeps_fingers_apart:
            for _ in range(MAX_PUSHES):
                if not push_apart(hand, work, status):
                    break
                solve_sample(hand, person, work, joints, num_near, status)
        for finger in range(num_fingers):
            for joint in range(hand.num_joints[finger]):
                output.joints_rad[t, finger, joint] = joints[finger, joint]
        output.status[t] = worst_of(status)
