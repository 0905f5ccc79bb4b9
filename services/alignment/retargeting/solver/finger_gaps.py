"""Gaps between neighbouring fingers: targets of fingers that overlap are moved apart."""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver.arrays import IMPLAUSIBLE, NUM_POINTS
from services.alignment.retargeting.solver.compiled import compiled

# Fingers that overlap by less are left.
TOUCH_M = 2e-4


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
