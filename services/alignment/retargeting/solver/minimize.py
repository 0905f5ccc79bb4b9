"""Levenberg–Marquardt with box constraints for one finger or a group of pinching fingers.

Levenberg–Marquardt with an active set: a joint at a border whose gradient points outward is held
there, a step is cut at the border, so that limits hold exactly. A group is one finger alone, or the
thumb and the fingers near it: an arrow-shaped system that is reduced to the thumb's block (Schur
complement).
"""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver.arrays import MAX_JOINTS
from services.alignment.retargeting.solver.compiled import compiled
from services.alignment.retargeting.solver.terms import evaluate

MAX_ITERATIONS = 40
# The step below it is still made: what is left is its square, or a tenth of it with residuals.
STEP_TOLERANCE_RAD = 3e-4
# A posture that a pinch only keeps near to need not be so exact.
POSTURE_TOLERANCE_RAD = 3e-3
DAMPING_START = 1e-6
DAMPING_RANGE = (1e-12, 1e3)
# Keeps a joint that moves nothing where it is; far below what the points see (m²/rad²).
RIDGE_M2 = 1e-12
# A start that reaches every point to a hundredth of a millimetre needs no other one beside it.
EXACT_COST_M2 = 1e-10


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
            for other in range(num_joints):
                hessian[joint, other] = 0.0
                hessian[other, joint] = 0.0
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
    for a in range(size):
        right[a] = -work.gradient[hub, a]
        for b in range(size):
            reduced[a, b] = work.hessian[hub, a, b]
    for finger in group[1:]:
        own = hand.num_joints[finger]
        solved = work.solved[finger]
        factor(work.hessian[finger], own)
        for b in range(own):
            solved[MAX_JOINTS, b] = work.gradient[finger, b]
            for a in range(size):
                solved[a, b] = work.coupling[finger, a, b]
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
                for joint in range(hand.num_joints[finger]):
                    joints[finger, joint] = work.trial[finger, joint]
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
            for joint in range(MAX_JOINTS):
                kept[joint] = joints[finger, joint]
        if best < EXACT_COST_M2:
            break
    for joint in range(MAX_JOINTS):
        joints[finger, joint] = kept[joint]
