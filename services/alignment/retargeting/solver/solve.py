"""Entry point of the compiled solver: joint angles for every sample of a tracked hand.

Every finger is a least-squares problem in a box: points of a *virtual hand* (the robot's axes, the
person's bones) against measured points, plus a pull towards the sample before. Thumb and fingers
near one another are solved together, by vectors between the robot's own fingertips.
"""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver import compiled, compiled_once
from services.alignment.retargeting.solver.arrays import (
    IMPLAUSIBLE,
    MISSING,
    NOMINAL_PERIOD_S,
    NUM_POINTS,
    PARTIAL,
    PINCH_NEAR_M,
    PINCH_WEIGHT,
    PINCH_WEIGHT_FAR,
    POSTURE_WEIGHT_M2,
    REACQUIRED,
    SOLVED,
    UNCONVERGED,
)
from services.alignment.retargeting.solver.minimize import (
    POSTURE_TOLERANCE_RAD,
    STEP_TOLERANCE_RAD,
    ease_bones,
    linearize,
    minimize,
    place_joints,
    solve_cold,
    weigh_bones,
)

# Two bones bent by more than 140° are an error of the tracker: hands and robot stop at 120°.
MAX_BEND_COSINE = -0.766
# Weights of bones change once a sample; where there was none before, so many times. Chosen: after
# faults (tests/accuracy/test_retargeting_fuzz.py) tips are within 0.9 mm of where they would be in
# five samples, and 2.1 with one.
COLD_ROUNDS = 10
# Bones whose length a live hand's noise is found from count so many samples back (see
# NUM_SAMPLES of the profile).
NUM_RECENT = 240
# What one wrong point may add to that noise: bones that are further off are errors of the tracker.
MAX_DEVIATION_M = 0.008
# Other lengths are no finger's bones in metres (BONE_RANGE_M of the profile).
MIN_LENGTH_M, MAX_LENGTH_M = 0.003, 0.150
# Mean of |x| of a normal distribution is 0.798 sigma; a bone's length has the noise of two points,
# and a point has it along three axes: v = 3 (mean / 0.798)² / 2.
VARIANCE_OF_DEVIATION = 3.0 * (np.pi / 2.0) / 2.0


@compiled
@no_type_check
def read_sample(hand, person, work, keypoints, memory):
    """The points of every finger, smoothed, into the scratch; a missing one is zero."""
    noise_m2 = person.noise_m2
    if noise_m2 < 0.0:
        noise_m2 = noise_of_bones(memory.bones_m, keypoints, hand.nodes)
    for finger in range(hand.num_fingers):
        for index in range(NUM_POINTS):
            node = hand.nodes[finger, index]
            x, y, z = keypoints[node, 0], keypoints[node, 1], keypoints[node, 2]
            seen = node >= 0 and np.isfinite(x) and np.isfinite(y) and np.isfinite(z)
            work.usable[finger, index] = seen
            point = memory.points_m[finger, index]
            if seen and noise_m2 > 0.0:
                follow_point(point, keypoints[node], noise_m2)
            else:
                point = keypoints[node]
            for k in range(3):
                work.measured[finger, index, k] = point[k] if seen else 0.0


@compiled
@no_type_check
def check_finger(hand, person, tuning, work, finger, memory):
    """Which points of a finger to use; SOLVED, PARTIAL, IMPLAUSIBLE or MISSING. Bones get a scale.

    Impossible bones or a knuckle far off reject the whole finger: which point is wrong is unknown.
    """
    measured, usable = work.measured[finger], work.usable[finger]
    count, expected = 0, 0
    for index in range(1, NUM_POINTS):
        count += 1 if usable[index] else 0
        expected += 1 if hand.nodes[finger, index] >= 0 else 0
    is_whole = count == expected and usable[0]
    if count < 2 or (not person.is_known and not is_whole):
        return MISSING
    work.scale[finger] = person.bone_scale[finger]
    work.freedom[finger] = person.freedom[finger]
    bones = work.bones
    bones[:] = 0.0
    for bone in range(3):
        if not (usable[bone] and usable[bone + 1]):
            continue
        squared = 0.0
        for k in range(3):
            bones[bone, k] = measured[bone + 1, k] - measured[bone, k]
            squared += bones[bone, k] ** 2
        length = np.sqrt(squared)
        known = person.bone_m[finger, bone]
        if person.is_known:
            if abs(length - known) > person.bone_tolerance_m[finger, bone]:
                return IMPLAUSIBLE
        elif not 0.003 <= length <= 0.150:
            return IMPLAUSIBLE
        if not person.is_rigid:
            work.scale[finger, bone] *= length / known
        if length > 0.0:
            for k in range(3):
                bones[bone, k] /= length
    for bone in range(2):
        cosine = 0.0
        for k in range(3):
            cosine += bones[bone, k] * bones[bone + 1, k]
        if cosine < MAX_BEND_COSINE:
            return IMPLAUSIBLE
    if person.is_known and usable[0]:
        error_m = knuckle_error_m(hand, person, tuning, work, finger, memory)
        if error_m > person.knuckle_tolerance_m[finger]:
            return IMPLAUSIBLE
    return SOLVED if is_whole else PARTIAL


@compiled
@no_type_check
def knuckle_error_m(hand, person, tuning, work, finger, memory):
    """Distance of a measured knuckle from its previous position, less possible travel since."""
    travel = person.travel[finger]
    base = hand.point_joints[finger, 0]
    origin = work.origin[finger]
    if travel > 0.0:
        place_joints(hand, finger, memory.alone_rad[finger], origin, work.axis[finger], work.turn)
    squared, arm = 0.0, 0.0
    for k in range(3):
        expected = person.knuckle_m[finger, k]
        if travel > 0.0:
            expected += travel * (origin[base, k] - hand.knuckle_m[finger, k])
            arm += (origin[base, k] - origin[0, k]) ** 2
        squared += (work.measured[finger, 0, k] - expected) ** 2
    turned = min(tuning.velocity_limit_rad_s * memory.unsolved_s[finger], 2.0)
    return np.sqrt(squared) - travel * np.sqrt(arm) * turned


@compiled
@no_type_check
def find_pinches(hand, tuning, work, status):
    """Thumb and fingers near it into `members` and `is_near`; vectors and log-even weights."""
    thumb, measured, usable = hand.thumb, work.measured, work.usable
    work.is_near[:] = 0
    if thumb < 0 or status[thumb] >= IMPLAUSIBLE or not usable[thumb, 3]:
        return 0
    count = 1
    work.members[0] = thumb
    for finger in range(hand.num_fingers):
        if finger == thumb or status[finger] >= IMPLAUSIBLE or not usable[finger, 3]:
            continue
        squared = 0.0
        for k in range(3):
            work.pinch_m[finger, k] = measured[thumb, 3, k] - measured[finger, 3, k]
            squared += work.pinch_m[finger, k] ** 2
        gap = np.sqrt(squared)
        if gap >= tuning.pinch_far_m:
            continue
        apart = max(gap - PINCH_NEAR_M, 0.0) / (tuning.pinch_far_m - PINCH_NEAR_M)
        work.pinch_weight[finger] = PINCH_WEIGHT * (PINCH_WEIGHT_FAR / PINCH_WEIGHT) ** apart
        work.members[count] = finger
        work.is_near[finger] = work.is_near[thumb] = 1
        count += 1
    return count if count > 1 else 0


@compiled
@no_type_check
def set_box(hand, work, finger, before_rad, reach):
    """Bounds of a finger's joints in this sample: limits, and the reach since the last one."""
    for joint in range(hand.num_joints[finger]):
        before = before_rad[finger, joint]
        work.before[finger, joint] = before
        # An infinite reach is none.
        work.lower[finger, joint] = max(hand.lower_rad[finger, joint], before - reach)
        work.upper[finger, joint] = min(hand.upper_rad[finger, joint], before + reach)


@compiled
@no_type_check
def tip_error(work, finger, num_joints):
    """Distance of the virtual tip from the measured one, before the small last step."""
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
        eases = not person.is_rigid
        if eases:
            weigh_bones(work, finger, memory.ease[finger])
        # Over a missing point, a bone is another one.
        is_whole = status[finger] == SOLVED
        num_rounds = 1
        if unsolved_s >= tuning.reacquire_after_s:
            num_rounds = COLD_ROUNDS if eases else 1
            solve_cold(hand, person, work, finger, memory.alone_rad, tuning.num_starts)
            if np.isfinite(unsolved_s):
                status[finger] = REACQUIRED
        else:
            work.pull_m2[finger] = tuning.temporal_weight_m2 * NOMINAL_PERIOD_S / unsolved_s
        alone[0] = finger
        tolerance_rad = POSTURE_TOLERANCE_RAD if work.is_near[finger] else STEP_TOLERANCE_RAD
        at_rest = False
        for _ in range(num_rounds):
            _, at_rest = minimize(hand, person, work, alone, memory.alone_rad, tolerance_rad)
            if eases and is_whole:
                ease_bones(work, finger, memory.ease[finger])
                weigh_bones(work, finger, memory.ease[finger])
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
        work.posture_weight_m2[finger] = POSTURE_WEIGHT_M2
        work.posture[finger] = alone[finger]
        is_lost = memory.unsolved_s[finger] >= tuning.reacquire_after_s
        if work.is_near[finger] and not (is_lost or memory.is_behind[finger]):
            continue
        for joint in range(hand.num_joints[finger]):
            lower, upper = work.lower[finger, joint], work.upper[finger, joint]
            joints[finger, joint] = min(max(alone[finger, joint], lower), upper)
    if num_near:
        group = work.members[:num_near]
        _, at_rest = minimize(hand, person, work, group, joints, STEP_TOLERANCE_RAD)
        for finger in group:
            errors_m[finger] = tip_error(work, finger, hand.num_joints[finger])
            if not at_rest:
                status[finger] = UNCONVERGED


@compiled
@no_type_check
def mark_reacquired(hand, person, work, memory, output):
    """Fingers kept by the box from where they are tracked are REACQUIRED, with their tip error."""
    status, errors_m = output
    for finger in range(hand.num_fingers):
        if status[finger] >= IMPLAUSIBLE or not memory.is_behind[finger]:
            continue
        is_held = False
        for joint in range(hand.num_joints[finger]):
            angle = memory.joints_rad[finger, joint]
            lower, upper = work.lower[finger, joint], work.upper[finger, joint]
            is_held |= angle <= lower and lower > hand.lower_rad[finger, joint]
            is_held |= angle >= upper and upper < hand.upper_rad[finger, joint]
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
    """Follow a tracked hand through T samples, from the `memory` before to that of the last.

    `tables` are hand, person, tuning and scratch, records of one element each; `samples` keypoints
    [T, K, 3] (m in wrist axes, not finite where missing) and elapsed_s [T].
    """
    keypoints, elapsed_s = samples
    hand, person, tuning, work = tables[0][0], tables[1][0], tables[2][0], tables[3][0]
    num_fingers = hand.num_fingers
    joints = memory.joints_rad
    for t in range(len(keypoints)):
        status = output.finger_status[t]
        found = (status, output.tip_error_m[t])
        read_sample(hand, person, work, keypoints[t], memory)
        work.elapsed_s = elapsed_s[t]
        work.sent[:num_fingers] = joints
        for finger in range(num_fingers):
            memory.unsolved_s[finger] += elapsed_s[t]
            status[finger] = check_finger(hand, person, tuning, work, finger, memory)
        num_near = find_pinches(hand, tuning, work, status)
        solve_alone(hand, person, tuning, work, memory, found)
        solve_pinches(hand, person, tuning, work, memory, num_near, found)
        mark_reacquired(hand, person, work, memory, found)
        for finger in range(num_fingers):
            if status[finger] < IMPLAUSIBLE:
                memory.unsolved_s[finger] = 0.0
        output.joints_rad[t] = joints
        output.status[t] = worst_of(status)


@compiled
@no_type_check
def follow_point(before, now, variance_m2):
    """Move a smoothed point, in place, to a new sample of it; NaN is no sample before."""
    squared = 0.0
    for k in range(3):
        squared += (now[k] - before[k]) ** 2
    part = 1.0
    if np.isfinite(squared) and squared > 0.0:
        part = squared / (squared + variance_m2)
        for k in range(3):
            before[k] += part * (now[k] - before[k])
    else:
        before[:] = now


@compiled
@no_type_check
def noise_of_bones(bones_m, keypoints, nodes):
    """Mean square of the noise's length, by how the lengths of bones differ from their mean.

    Bones [F, 3, 3] are changed: how often seen, mean length and mean deviation of each. Keypoints
    are [K, 3] of one sample; nodes [F, 4] of knuckle, PIP, DIP and tip, or -1.
    """
    total, count = 0.0, 0
    for finger in range(len(bones_m)):
        for bone in range(3):
            a, b = nodes[finger, bone], nodes[finger, bone + 1]
            one = bones_m[finger, bone]
            squared = np.nan
            if a >= 0 and b >= 0:
                squared = 0.0
                for k in range(3):
                    squared += (keypoints[a, k] - keypoints[b, k]) ** 2
            length = np.sqrt(squared)
            # False for NaN, too.
            if MIN_LENGTH_M <= length <= MAX_LENGTH_M:
                one[0] = min(one[0] + 1.0, NUM_RECENT)
                if one[0] == 1.0:
                    one[1] = length
                off = min(max(length - one[1], -MAX_DEVIATION_M), MAX_DEVIATION_M)
                one[1] += off / one[0]
                one[2] += (abs(off) - one[2]) / one[0]
            if one[0] > 0.0:
                total += one[2]
                count += 1
    return VARIANCE_OF_DEVIATION * (total / max(count, 1)) ** 2


@compiled_once
@no_type_check
def smooth_forward(keypoints, variance_m2):
    """Smooth the nodes of keypoints [T, K, 3] in time, in place; NaN stays, and is passed over."""
    for node in range(keypoints.shape[1]):
        before = keypoints[0, node].copy()
        for t in range(1, len(keypoints)):
            if np.isfinite(keypoints[t, node]).all():
                follow_point(before, keypoints[t, node], variance_m2)
                keypoints[t, node] = before


def smoothed(keypoints_m: np.ndarray, sigma_m: float) -> np.ndarray:
    """Keypoints [T, K, 3] smoothed by the tracker's sigma both ways; the mean has no lag."""
    passes = keypoints_m.copy(), keypoints_m[::-1].copy()
    for one in passes:
        smooth_forward(one, 3.0 * sigma_m**2)
    return np.asarray((passes[0] + passes[1][::-1]) / 2)
