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
    NUM_POINTS,
    PARTIAL,
    REACQUIRED,
    UNCONVERGED,
)
from services.alignment.retargeting.solver.compiled import compiled, compiled_once
from services.alignment.retargeting.solver.minimize import (
    POSTURE_TOLERANCE_RAD,
    STEP_TOLERANCE_RAD,
    linearize,
    minimize,
    solve_cold,
)
from services.alignment.retargeting.solver.plausibility import (
    check_finger,
    find_pinches,
    read_sample,
)

# How often fingers are pushed apart in one sample; those that overlap by less are left.
MAX_PUSHES = 4
TOUCH_M = 2e-4


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


@compiled
@no_type_check
def segment_gap(a0, a1, b0, b1):
    """Closest points of two segments: their parameters, the vector from a to b and its length.

    Ericson, Real-Time Collision Detection, 5.1.9, for segments of some length.
    """
    aa = ab = bb = ac = bc = 0.0
    for k in range(3):
        da, db, c = a1[k] - a0[k], b1[k] - b0[k], a0[k] - b0[k]
        aa += da * da
        bb += db * db
        ab += da * db
        ac += da * c
        bc += db * c
    denominator = aa * bb - ab * ab
    s = min(max((ab * bc - ac * bb) / denominator, 0.0), 1.0) if denominator > 1e-15 else 0.5
    t = (ab * s + bc) / bb
    if not 0.0 <= t <= 1.0:
        t = min(max(t, 0.0), 1.0)
        s = min(max((ab * t - ac) / aa, 0.0), 1.0)
    x = b0[0] + t * (b1[0] - b0[0]) - a0[0] - s * (a1[0] - a0[0])
    y = b0[1] + t * (b1[1] - b0[1]) - a0[1] - s * (a1[1] - a0[1])
    z = b0[2] + t * (b1[2] - b0[2]) - a0[2] - s * (a1[2] - a0[2])
    return s, t, x, y, z, np.sqrt(x * x + y * y + z * z)


@compiled
@no_type_check
def robot_point(hand, work, finger, index):
    """Knuckle, PIP, DIP or tip of the robot's finger, as last linearized."""
    at = hand.point_joints[finger, index] if index < 3 else hand.num_joints[finger]
    return work.origin[finger, at]


@compiled
@no_type_check
def push(hand, work, finger, phalanx, along, distance_m):
    """Move a finger's measured points along `push_m`, more the further from the knuckle."""
    knuckle = robot_point(hand, work, finger, 0)
    before, after = (
        robot_point(hand, work, finger, phalanx),
        robot_point(hand, work, finger, phalanx + 1),
    )
    squared = 0.0
    for k in range(3):
        squared += (before[k] + along * (after[k] - before[k]) - knuckle[k]) ** 2
    arm = max(np.sqrt(squared), 0.02)
    for index in range(1, NUM_POINTS):
        point = robot_point(hand, work, finger, index)
        squared = 0.0
        for k in range(3):
            squared += (point[k] - knuckle[k]) ** 2
        lever = min(np.sqrt(squared) / arm, 3.0) * work.scale[finger, 0]
        for k in range(3):
            work.measured[finger, index, k] += lever * distance_m * work.push_m[k]


@compiled
@no_type_check
def push_apart(hand, work, status):
    """Move the targets of neighbouring fingers that overlap apart; whether any."""
    touched = False
    push_m = work.push_m
    for a in range(hand.num_fingers - 1):
        b = a + 1
        if hand.thumb in (a, b) or status[a] >= IMPLAUSIBLE or status[b] >= IMPLAUSIBLE:
            continue
        depth, at_a, at_b, along_a, along_b = 0.0, -1, -1, 0.0, 0.0
        for i in range(3):
            for j in range(3):
                s, t, x, y, z, gap = segment_gap(
                    robot_point(hand, work, a, i),
                    robot_point(hand, work, a, i + 1),
                    robot_point(hand, work, b, j),
                    robot_point(hand, work, b, j + 1),
                )
                missing = hand.radius_m[a, i] + hand.radius_m[b, j] - gap
                # Axes that cross have no direction to part in.
                if missing > depth and gap > 1e-6:
                    depth, at_a, at_b, along_a, along_b = missing, i, j, s, t
                    push_m[0], push_m[1], push_m[2] = x / gap, y / gap, z / gap
        if depth > TOUCH_M:
            touched = True
            push(hand, work, b, at_b, along_b, 0.5 * depth)
            push(hand, work, a, at_a, along_a, -0.5 * depth)
    return touched


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
