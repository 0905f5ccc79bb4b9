"""Cost, gradient and Gauss–Newton Hessian of a group of fingers."""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver.arrays import NUM_POINTS
from services.alignment.retargeting.solver.compiled import compiled
from services.alignment.retargeting.solver.points import linearize


@compiled
@no_type_check
def finger_terms(work, finger, num_joints, joints):
    """Cost of one finger; its Hessian (Gauss–Newton) and gradient into the scratch.

    An unknown shift of the knuckle that all points share is integrated out: with a variance of
    rho times a point's, residuals lose 1 - 1/sqrt(1 + K rho) of their mean.
    """
    measured, usable = work.measured, work.usable
    hessian, gradient = work.hessian[finger], work.gradient[finger]
    point, slope = work.point[finger], work.slope[finger]
    hessian[:] = 0.0
    gradient[:] = 0.0
    count = 0
    for index in range(NUM_POINTS):
        count += 1 if usable[finger, index] else 0
    share = (1.0 - 1.0 / np.sqrt(1.0 + count * work.freedom[finger])) / count
    cost = 0.0
    row, mean_slope = work.row[0], work.row[1]
    for k in range(3):
        mean = 0.0
        mean_slope[:] = 0.0
        for index in range(NUM_POINTS):
            if usable[finger, index]:
                mean += share * (point[index, k] - measured[finger, index, k])
                for joint in range(num_joints):
                    mean_slope[joint] += share * slope[index, joint, k]
        for index in range(NUM_POINTS):
            if not usable[finger, index]:
                continue
            residual = point[index, k] - measured[finger, index, k] - mean
            cost += residual * residual
            for joint in range(num_joints):
                row[joint] = slope[index, joint, k] - mean_slope[joint]
                gradient[joint] += row[joint] * residual
                for other in range(joint + 1):
                    hessian[joint, other] += row[joint] * row[other]
    pull, keep = work.pull_m2[finger], work.posture_weight_m2[finger]
    for joint in range(num_joints):
        moved = joints[joint] - work.before[finger, joint]
        bent = joints[joint] - work.posture[finger, joint]
        cost += pull * moved * moved + keep * bent * bent
        gradient[joint] += pull * moved + keep * bent
        hessian[joint, joint] += pull + keep
        for other in range(joint):
            hessian[other, joint] = hessian[joint, other]
    return cost


@compiled
@no_type_check
def pinch_terms(hand, work, group):
    """Cost of the vectors from fingertips to the thumb's; their terms are added to the scratch."""
    thumb = group[0]
    thumb_joints = hand.num_joints[thumb]
    thumb_tip, thumb_slope = work.origin[thumb, thumb_joints], work.tip_slope[thumb]
    pushed = work.push_m
    pushed[:] = 0.0
    cost, total = 0.0, 0.0
    for finger in group[1:]:
        num_joints = hand.num_joints[finger]
        tip, tip_slope = work.origin[finger, num_joints], work.tip_slope[finger]
        hessian, coupling = work.hessian[finger], work.coupling[finger]
        gradient = work.gradient[finger]
        weight = work.pinch_weight[finger]
        total += weight
        coupling[:] = 0.0
        for k in range(3):
            residual = thumb_tip[k] - tip[k] - work.pinch_m[finger, k]
            cost += weight * residual * residual
            pushed[k] += weight * residual
            for b in range(num_joints):
                slope = weight * tip_slope[b, k]
                gradient[b] -= slope * residual
                for a in range(thumb_joints):
                    coupling[a, b] -= slope * thumb_slope[a, k]
                for other in range(num_joints):
                    hessian[b, other] += slope * tip_slope[other, k]
    for k in range(3):
        for a in range(thumb_joints):
            slope = total * thumb_slope[a, k]
            work.gradient[thumb, a] += pushed[k] * thumb_slope[a, k]
            for b in range(thumb_joints):
                work.hessian[thumb, a, b] += slope * thumb_slope[b, k]
    return cost


@compiled
@no_type_check
def evaluate(hand, person, work, group, joints):
    """Cost, Hessian blocks and gradient of a group: the thumb first, or one finger alone."""
    cost = 0.0
    for finger in group:
        linearize(hand, person, work, finger, joints[finger])
        cost += finger_terms(work, finger, hand.num_joints[finger], joints[finger])
    if len(group) > 1:
        cost += pinch_terms(hand, work, group)
    return cost
