"""The least-squares problem of one finger or a group of pinching fingers, and its minimizer.

Levenberg–Marquardt with an active set: a joint at a border whose gradient points outward is held, a
step is cut at the border. Pinching fingers are an arrow-shaped system that is reduced to the
thumb's block (Schur complement).
"""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver import compiled
from services.alignment.retargeting.solver.arrays import MAX_JOINTS, NUM_POINTS

MAX_ITERATIONS = 40
# The step below it is still made: what is left is its square, or a tenth of it with residuals.
STEP_TOLERANCE_RAD = 3e-4
# A posture that a pinch only keeps near to need not be so exact.
POSTURE_TOLERANCE_RAD = 3e-3
DAMPING_START = 1e-6
DAMPING_RANGE = (1e-12, 1e3)
# Keeps a joint that moves nothing where it is; far below what the points see (m²/rad²).
RIDGE_M2 = 1e-12
# Directions count as points at this distance. Chosen: the longest bone of the mean hand's fingers.
BONE_M = 0.04
# Beyond 1.7 degrees a bone's direction counts in proportion to its angle. Chosen: the mean angle of
# a real hand's thumb is 7.4 degrees, 8.4 with squares alone; the best possible is 7.0.
BONE_BEND_RAD = 0.03
# Keeps the weight of a bone of no length finite.
LEAST_LENGTH_M2 = 1e-12
# A start that reaches every point to a hundredth of a millimetre needs no other one beside it.
EXACT_COST_M2 = 1e-10


@compiled
@no_type_check
def place_joints(hand, finger, joints, origin, axis, turn):
    """Origins and axes of a finger's joints and its tip, wrist coordinates."""
    turn[:] = 0.0
    turn[0, 0] = turn[1, 1] = turn[2, 2] = 1.0
    last = hand.num_joints[finger]
    place = origin[last]
    place[:] = 0.0
    for joint in range(last):
        offset, fixed = hand.position_m[finger, joint], hand.rotation[finger, joint]
        is_turned = hand.is_turned[finger, joint] == 1
        c, s = np.cos(joints[joint]), np.sin(joints[joint])
        for row in range(3):
            x, y, z = turn[row, 0], turn[row, 1], turn[row, 2]
            place[row] += x * offset[0] + y * offset[1] + z * offset[2]
            origin[joint, row] = place[row]
            if is_turned:
                r0, r1, r2 = x, y, z
                x = r0 * fixed[0, 0] + r1 * fixed[1, 0] + r2 * fixed[2, 0]
                y = r0 * fixed[0, 1] + r1 * fixed[1, 1] + r2 * fixed[2, 1]
                z = r0 * fixed[0, 2] + r1 * fixed[1, 2] + r2 * fixed[2, 2]
            axis[joint, row] = z
            turn[row, 0], turn[row, 1], turn[row, 2] = c * x + s * y, c * y - s * x, z
    tip = hand.tip_m[finger]
    for row in range(3):
        place[row] += turn[row, 0] * tip[0] + turn[row, 1] * tip[1] + turn[row, 2] * tip[2]


@compiled
@no_type_check
def linearize(hand, person, work, finger, joints):
    """Points of the virtual finger and their slopes; a hinge moves a point by axis × lever."""
    origin, axis = work.origin[finger], work.axis[finger]
    place_joints(hand, finger, joints, origin, axis, work.turn)
    last = hand.num_joints[finger]
    point, slope, own = work.point[finger], work.slope[finger], work.own_slope[finger]
    for index in range(NUM_POINTS):
        at = hand.point_joints[finger, index] if index < 3 else last
        for joint in range(last):
            if joint < at:
                ax, ay, az = axis[joint, 0], axis[joint, 1], axis[joint, 2]
                dx = origin[at, 0] - origin[joint, 0]
                dy = origin[at, 1] - origin[joint, 1]
                dz = origin[at, 2] - origin[joint, 2]
                own[index, joint, 0] = ay * dz - az * dy
                own[index, joint, 1] = az * dx - ax * dz
                own[index, joint, 2] = ax * dy - ay * dx
            else:
                own[index, joint, 0] = own[index, joint, 1] = own[index, joint, 2] = 0.0
        for k in range(3):
            if index == 0:
                travel = person.travel[finger]
                moved = origin[at, k] - hand.knuckle_m[finger, k]
                point[0, k] = person.knuckle_m[finger, k] + travel * moved
                for joint in range(last):
                    slope[0, joint, k] = travel * own[0, joint, k]
            else:
                scale = work.scale[finger, index - 1]
                base = hand.point_joints[finger, index - 1]
                point[index, k] = point[index - 1, k] + scale * (origin[at, k] - origin[base, k])
                for joint in range(last):
                    bone = own[index, joint, k] - own[index - 1, joint, k]
                    slope[index, joint, k] = slope[index - 1, joint, k] + scale * bone


@compiled
@no_type_check
def point_terms(work, finger, num_joints):
    """Squared distances of points, for a hand whose bones and knuckles are known exactly.

    An unknown shift of the knuckle that all points share is integrated out: with a variance of
    rho times a point's, residuals lose 1 - 1/sqrt(1 + K rho) of their mean.
    """
    measured, usable = work.measured, work.usable
    hessian, gradient = work.hessian[finger], work.gradient[finger]
    point, slope = work.point[finger], work.slope[finger]
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
    return cost


@compiled
@no_type_check
def bone_terms(hand, work, finger):
    """Squared differences of people's unit bones times `BONE_M`; chords over missing points."""
    measured, usable = work.measured[finger], work.usable[finger]
    hessian, gradient = work.hessian[finger], work.gradient[finger]
    point, slope = work.point[finger], work.slope[finger]
    cost, row = 0.0, work.row[0]
    base = -1
    for index in range(NUM_POINTS):
        if not usable[index]:
            continue
        if base >= 0:
            weight = work.bone_weight[finger, index - 1]
            # Joints further out do not turn this bone.
            num_joints = hand.point_joints[finger, index] if index < 3 else hand.num_joints[finger]
            for k in range(3):
                residual = point[index, k] - point[base, k] - measured[index, k] + measured[base, k]
                cost += weight * residual * residual
                for joint in range(num_joints):
                    row[joint] = slope[index, joint, k] - slope[base, joint, k]
                    gradient[joint] += weight * row[joint] * residual
                    for other in range(joint + 1):
                        hessian[joint, other] += weight * row[joint] * row[other]
        base = index
    return cost


@compiled
@no_type_check
def weigh_bones(work, finger, ease):
    """Weights of a finger's bones from their lengths and `ease`, which is kept between samples."""
    measured, usable = work.measured[finger], work.usable[finger]
    base = -1
    for index in range(NUM_POINTS):
        if not usable[index]:
            continue
        if base >= 0:
            squared = LEAST_LENGTH_M2
            for k in range(3):
                squared += (measured[index, k] - measured[base, k]) ** 2
            work.bone_weight[finger, index - 1] = ease[index - 1] * BONE_M**2 / squared
        base = index


@compiled
@no_type_check
def ease_bones(work, finger, ease):
    """Give less weight to bones that the robot cannot turn so (pseudo-Huber, `BONE_BEND_RAD`)."""
    measured, usable, point = work.measured[finger], work.usable[finger], work.point[finger]
    base = -1
    for index in range(NUM_POINTS):
        if not usable[index]:
            continue
        if base >= 0:
            squared, length = 0.0, LEAST_LENGTH_M2
            for k in range(3):
                bone = measured[index, k] - measured[base, k]
                squared += (point[index, k] - point[base, k] - bone) ** 2
                length += bone * bone
            ease[index - 1] = 1.0 / np.sqrt(1.0 + squared / (length * BONE_BEND_RAD**2))
        base = index


@compiled
@no_type_check
def finger_terms(hand, person, work, finger, joints):
    """Cost of one finger; its Hessian (Gauss–Newton) and gradient into the scratch."""
    hessian, gradient = work.hessian[finger], work.gradient[finger]
    num_joints = hand.num_joints[finger]
    hessian[:] = 0.0
    gradient[:] = 0.0
    if person.is_rigid:
        cost = point_terms(work, finger, num_joints)
    else:
        cost = bone_terms(hand, work, finger)
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
    thumb_tip, thumb_slope = work.origin[thumb, thumb_joints], work.own_slope[thumb, 3]
    pushed = work.push_m
    pushed[:] = 0.0
    cost, total = 0.0, 0.0
    for finger in group[1:]:
        num_joints = hand.num_joints[finger]
        tip, tip_slope = work.origin[finger, num_joints], work.own_slope[finger, 3]
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
        cost += finger_terms(hand, person, work, finger, joints[finger])
    if len(group) > 1:
        cost += pinch_terms(hand, work, group)
    return cost


@compiled
@no_type_check
def hold_and_damp(work, finger, num_joints, joints, damping):
    """Held joints leave the system of their finger; the diagonal is damped. Returns nothing."""
    hessian, gradient = work.hessian[finger], work.gradient[finger]
    for joint in range(num_joints):
        held = (joints[joint] <= work.lower[finger, joint] and gradient[joint] > 0.0) or (
            joints[joint] >= work.upper[finger, joint] and gradient[joint] < 0.0
        )
        if held:
            gradient[joint] = 0.0
            hessian[joint, :] = 0.0
            hessian[:, joint] = 0.0
            hessian[joint, joint] = 1.0
            # What ties this joint to the thumb (columns), or the thumb to a finger (rows).
            work.coupling[finger, :, joint] = 0.0
        else:
            diagonal = hessian[joint, joint]
            hessian[joint, joint] += damping * (1e-4 + diagonal) + RIDGE_M2
        work.step[finger, joint] = 1.0 if held else 0.0


@compiled
@no_type_check
def factor(matrix, size):
    """Cholesky factor into the lower half; a damped, positive definite matrix is expected."""
    for row in range(size):
        for column in range(row + 1):
            rest = matrix[row, column]
            for k in range(column):
                rest -= matrix[row, k] * matrix[column, k]
            matrix[row, column] = (
                np.sqrt(max(rest, RIDGE_M2)) if row == column else rest / matrix[column, column]
            )


@compiled
@no_type_check
def substitute(matrix, size, right):
    """Solve with a Cholesky factor, in place."""
    for row in range(size):
        for k in range(row):
            right[row] -= matrix[row, k] * right[k]
        right[row] /= matrix[row, row]
    for row in range(size - 1, -1, -1):
        for k in range(row + 1, size):
            right[row] -= matrix[k, row] * right[k]
        right[row] /= matrix[row, row]


@compiled
@no_type_check
def damped_step(hand, work, group, joints, damping):
    """Damped Gauss–Newton step of a group into the scratch: fingers out, thumb, fingers back."""
    hub = group[0]
    size = hand.num_joints[hub]
    for finger in group:
        hold_and_damp(work, finger, hand.num_joints[finger], joints[finger], damping)
    for finger in group[1:]:
        for joint in range(size):
            if work.step[hub, joint] == 1.0:
                work.coupling[finger, joint, :] = 0.0
    reduced, right = work.reduced, work.step[hub]
    reduced[:] = work.hessian[hub]
    for a in range(size):
        right[a] = -work.gradient[hub, a]
    for finger in group[1:]:
        own = hand.num_joints[finger]
        solved = work.solved[finger]
        factor(work.hessian[finger], own)
        solved[:MAX_JOINTS] = work.coupling[finger]
        solved[MAX_JOINTS] = work.gradient[finger]
        substitute(work.hessian[finger], own, solved[MAX_JOINTS])
        for a in range(size):
            substitute(work.hessian[finger], own, solved[a])
        for a in range(size):
            for b in range(own):
                right[a] += work.coupling[finger, a, b] * solved[MAX_JOINTS, b]
                for c in range(size):
                    reduced[a, c] -= work.coupling[finger, a, b] * solved[c, b]
    factor(reduced, size)
    substitute(reduced, size, right)
    for finger in group[1:]:
        solved = work.solved[finger]
        for b in range(hand.num_joints[finger]):
            change = -solved[MAX_JOINTS, b]
            for a in range(size):
                change -= solved[a, b] * right[a]
            work.step[finger, b] = change


@compiled
@no_type_check
def minimize(hand, person, work, group, joints, tolerance_rad):
    """Least cost of a group inside its box, from where its joints are; cost and whether at rest."""
    cost = evaluate(hand, person, work, group, joints)
    damping = DAMPING_START
    for _ in range(MAX_ITERATIONS):
        damped_step(hand, work, group, joints, damping)
        moved = 0.0
        for finger in group:
            for joint in range(hand.num_joints[finger]):
                wanted = joints[finger, joint] + work.step[finger, joint]
                wanted = min(max(wanted, work.lower[finger, joint]), work.upper[finger, joint])
                work.trial[finger, joint] = wanted
                moved = max(moved, abs(wanted - joints[finger, joint]))
        if moved < tolerance_rad:
            # So small a step needs no look at its cost.
            for finger in group:
                for joint in range(hand.num_joints[finger]):
                    trial = work.trial[finger, joint]
                    work.step[finger, joint] = trial - joints[finger, joint]
                    joints[finger, joint] = trial
            return cost, True
        new_cost = evaluate(hand, person, work, group, work.trial)
        if new_cost <= cost:
            cost = new_cost
            for finger in group:
                joints[finger] = work.trial[finger]
            damping = max(0.2 * damping, DAMPING_RANGE[0])
        else:
            damping = min(8.0 * damping, DAMPING_RANGE[1])
            evaluate(hand, person, work, group, joints)
    for finger in group:
        work.step[finger, :] = 0.0
    return cost, False


@compiled
@no_type_check
def solve_cold(hand, person, work, finger, joints, num_starts):
    """The best of several starts of one finger alone."""
    group = work.members[-1:]
    group[0] = finger
    best = np.inf
    kept = work.best
    for start in range(num_starts):
        for joint in range(hand.num_joints[finger]):
            angle = hand.starts_rad[start, finger, joint]
            joints[finger, joint] = min(
                max(angle, work.lower[finger, joint]), work.upper[finger, joint]
            )
        cost, _ = minimize(hand, person, work, group, joints, STEP_TOLERANCE_RAD)
        # A hair of difference is rounding, not another minimum: keep the first.
        if cost < best * (1.0 - 1e-6):
            best = cost
            kept[:] = joints[finger]
        if best < EXACT_COST_M2:
            break
    joints[finger] = kept
