"""Plausibility of tracked keypoints, sample by sample, and detection of pinches."""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver.arrays import (
    IMPLAUSIBLE,
    MISSING,
    NUM_POINTS,
    PARTIAL,
    PINCH_WEIGHT_FAR,
    SOLVED,
)
from services.alignment.retargeting.solver.compiled import compiled
from services.alignment.retargeting.solver.minimize import place_joints

# Two bones bent by more than 140° are an error of the tracker: hands and robot stop at 120°.
MAX_BEND_COSINE = -0.766


@compiled
@no_type_check
def read_sample(hand, work, keypoints):
    """The points of every finger into the scratch; a missing one is zero."""
    for finger in range(hand.num_fingers):
        for index in range(NUM_POINTS):
            node = hand.nodes[finger, index]
            x, y, z = keypoints[node, 0], keypoints[node, 1], keypoints[node, 2]
            seen = node >= 0 and np.isfinite(x) and np.isfinite(y) and np.isfinite(z)
            work.usable[finger, index] = seen
            point = work.measured[finger, index]
            point[0] = x if seen else 0.0
            point[1] = y if seen else 0.0
            point[2] = z if seen else 0.0


@compiled
@no_type_check
def check_finger(hand, person, tuning, work, finger, memory):
    """Which points of a finger to use; SOLVED, PARTIAL, IMPLAUSIBLE or MISSING. Bones get a scale.

    Bones of a length or a bend that no finger has, and knuckles far from where they belong, are
    errors of the tracker; the whole finger is rejected, because the wrong point cannot be
    identified.
    """
    measured, usable = work.measured[finger], work.usable[finger]
    count, expected = 0, 0
    for index in range(1, NUM_POINTS):
        count += 1 if usable[index] else 0
        expected += 1 if hand.nodes[finger, index] >= 0 else 0
    is_whole = count == expected and usable[0]
    if count < 2 or (not person.is_known and not is_whole):
        return MISSING
    for k in range(3):
        work.scale[finger, k] = person.bone_scale[finger, k]
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
    """The thumb and all fingers near it into `members` and `is_near`; vectors and weights.

    The weight goes from that of near to that of far evenly in its logarithm.
    """
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
        apart = max(gap - tuning.pinch_near_m, 0.0) / (tuning.pinch_far_m - tuning.pinch_near_m)
        work.pinch_weight[finger] = (
            tuning.pinch_weight * (PINCH_WEIGHT_FAR / tuning.pinch_weight) ** apart
        )
        work.members[count] = finger
        work.is_near[finger] = work.is_near[thumb] = 1
        count += 1
    return count if count > 1 else 0
