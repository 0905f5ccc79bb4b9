"""Entry point of the compiled solver: joint angles for every sample of a tracked hand.

Every finger is a small least-squares problem in a box: points of a *virtual hand* (the robot's
axes, the person's bones) against measured points, plus a pull towards the sample before. Thumb and
fingers that come near one another are solved together: vectors between the robot's own fingertips
against the measured ones.
"""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver.arrays import (
    IMPLAUSIBLE,
    MISSING,
    NOMINAL_PERIOD_S,
    PARTIAL,
    REACQUIRED,
    UNCONVERGED,
)
from services.alignment.retargeting.solver.compiled import compiled, compiled_once
from services.alignment.retargeting.solver.finger_gaps import push_apart
from services.alignment.retargeting.solver.minimize import (
    POSTURE_TOLERANCE_RAD,
    STEP_TOLERANCE_RAD,
    minimize,
    solve_cold,
)
from services.alignment.retargeting.solver.plausibility import (
    check_finger,
    find_pinches,
    read_sample,
)
from services.alignment.retargeting.solver.points import linearize

# How often fingers are pushed apart in one sample.
MAX_PUSHES = 4


@compiled
@no_type_check
def set_box(hand, work, finger, before_rad, reach):
    """Bounds of a finger's joints in this sample: limits, and the reach since the last one."""
    for joint in range(hand.num_joints[finger]):
        before = before_rad[finger, joint]
        lower, upper = hand.lower_rad[finger, joint], hand.upper_rad[finger, joint]
        if np.isfinite(reach):
            lower, upper = max(lower, before - reach), min(upper, before + reach)
        work.lower[finger, joint] = lower
        work.upper[finger, joint] = upper
        work.before[finger, joint] = before


@compiled
@no_type_check
def tip_error(work, finger, num_joints):
    """Distance of the virtual tip from the measured one, both seen from the knuckle if it was.

    Points are those before the last step, which is small enough for their slopes.
    """
    if not work.usable[finger, 3]:
        return 0.0
    squared = 0.0
    for k in range(3):
        error = work.point[finger, 3, k] - work.measured[finger, 3, k]
        for joint in range(num_joints):
            error += work.slope[finger, 3, joint, k] * work.step[finger, joint]
        if work.usable[finger, 0]:
            error -= work.point[finger, 0, k] - work.measured[finger, 0, k]
            for joint in range(num_joints):
                error -= work.slope[finger, 0, joint, k] * work.step[finger, joint]
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
def solve_alone(hand, person, tuning, work, memory, output):
    """Every finger by its own points, as if there were no pinch."""
    status, errors_m = output
    alone = work.members[-1:]
    for finger in range(hand.num_fingers):
        if status[finger] >= IMPLAUSIBLE:
            errors_m[finger] = 0.0
            continue
        unsolved_s = memory.unsolved_s[finger]
        reach = tuning.velocity_limit_rad_s * unsolved_s
        set_box(hand, work, finger, memory.alone_rad, reach)
        work.posture_weight_m2[finger] = 0.0
        work.pull_m2[finger] = 0.0
        if unsolved_s >= tuning.reacquire_after_s:
            solve_cold(hand, person, work, finger, memory.alone_rad, tuning.num_starts)
            if np.isfinite(unsolved_s):
                status[finger] = REACQUIRED
        else:
            work.pull_m2[finger] = tuning.temporal_weight_m2 * NOMINAL_PERIOD_S / unsolved_s
        alone[0] = finger
        tolerance_rad = POSTURE_TOLERANCE_RAD if work.is_near[finger] else STEP_TOLERANCE_RAD
        _, at_rest = minimize(hand, person, work, alone, memory.alone_rad, tolerance_rad)
        if not at_rest:
            status[finger] = UNCONVERGED
        errors_m[finger] = tip_error(work, finger, hand.num_joints[finger])


@compiled
@no_type_check
def solve_pinches(hand, person, tuning, work, memory, num_near, output):
    """The thumb and the fingers near it together, close to what each does alone.

    The others as they are; no joint leaves the box around the previous result. That box grows with
    the time a finger was lost, but live, where the time of one output is all that motors have.
    """
    status, errors_m = output
    joints, alone = memory.joints_rad, memory.alone_rad
    for finger in range(hand.num_fingers):
        if status[finger] >= IMPLAUSIBLE:
            continue
        reach = tuning.velocity_limit_rad_s * memory.unsolved_s[finger]
        if tuning.is_live:
            allowed = min(tuning.velocity_limit_rad_s * work.elapsed_s, tuning.max_step_rad)
            if reach > allowed * (1.0 + 1e-9):
                memory.is_behind[finger] = 1
            reach = allowed
        set_box(hand, work, finger, work.sent, reach)
        work.posture_weight_m2[finger] = tuning.posture_weight_m2
        for joint in range(hand.num_joints[finger]):
            work.posture[finger, joint] = alone[finger, joint]
    group = work.members[:num_near]
    for finger in range(hand.num_fingers):
        if status[finger] >= IMPLAUSIBLE:
            continue
        is_lost = memory.unsolved_s[finger] >= tuning.reacquire_after_s
        if work.is_near[finger] and not (is_lost or memory.is_behind[finger]):
            continue
        for joint in range(hand.num_joints[finger]):
            lower, upper = work.lower[finger, joint], work.upper[finger, joint]
            joints[finger, joint] = min(max(alone[finger, joint], lower), upper)
    if num_near:
        _, at_rest = minimize(hand, person, work, group, joints, STEP_TOLERANCE_RAD)
        for finger in group:
            errors_m[finger] = tip_error(work, finger, hand.num_joints[finger])
            if not at_rest:
                status[finger] = UNCONVERGED


@compiled
@no_type_check
def mark_reacquired(hand, person, work, memory, output):
    """Fingers that the box keeps from where they are tracked are REACQUIRED until they are there.

    Their tip error is that of the angles that come out.
    """
    status, errors_m = output
    for finger in range(hand.num_fingers):
        if status[finger] >= IMPLAUSIBLE or not memory.is_behind[finger]:
            continue
        is_held = False
        for joint in range(hand.num_joints[finger]):
            angle = memory.joints_rad[finger, joint]
            lower, upper = work.lower[finger, joint], work.upper[finger, joint]
            if angle <= lower and lower > hand.lower_rad[finger, joint]:
                is_held = True
            if angle >= upper and upper < hand.upper_rad[finger, joint]:
                is_held = True
        if not is_held:
            memory.is_behind[finger] = 0
            continue
        status[finger] = max(status[finger], REACQUIRED)
        linearize(hand, person, work, finger, memory.joints_rad[finger])
        work.step[finger, :] = 0.0
        errors_m[finger] = tip_error(work, finger, hand.num_joints[finger])


@compiled_once
@no_type_check
def retarget_samples(tables, samples, memory, output):
    """Follow a tracked hand through T samples.

    Args:
        tables: (hand, person, tuning, scratch), records of one element each.
        samples: (keypoints [T, K, 3] m in wrist axes, NaN or infinite where missing; elapsed_s
            [T], since the sample before).
        memory: `Memory`, of the sample before the first; afterwards of the last.
        output: `Output`, filled.
    """
    keypoints, elapsed_s = samples
    hand, person, tuning, work = tables[0][0], tables[1][0], tables[2][0], tables[3][0]
    num_fingers = hand.num_fingers
    joints = memory.joints_rad
    for t in range(len(keypoints)):
        status = output.finger_status[t]
        found = (status, output.tip_error_m[t])
        read_sample(hand, work, keypoints[t])
        work.elapsed_s = elapsed_s[t]
        for finger in range(num_fingers):
            for joint in range(hand.num_joints[finger]):
                work.sent[finger, joint] = joints[finger, joint]
            memory.unsolved_s[finger] += elapsed_s[t]
            status[finger] = check_finger(hand, person, tuning, work, finger, memory)
        num_near = find_pinches(hand, tuning, work, status)
        solve_alone(hand, person, tuning, work, memory, found)
        solve_pinches(hand, person, tuning, work, memory, num_near, found)
        if tuning.keeps_fingers_apart:
            for _ in range(MAX_PUSHES):
                if not push_apart(hand, work, status):
                    break
                solve_alone(hand, person, tuning, work, memory, found)
                solve_pinches(hand, person, tuning, work, memory, num_near, found)
        mark_reacquired(hand, person, work, memory, found)
        for finger in range(num_fingers):
            if status[finger] < IMPLAUSIBLE:
                memory.unsolved_s[finger] = 0.0
            for joint in range(hand.num_joints[finger]):
                output.joints_rad[t, finger, joint] = joints[finger, joint]
        output.status[t] = worst_of(status)
