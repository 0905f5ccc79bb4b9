"""Forward kinematics of the virtual finger and its Jacobian."""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver.arrays import NUM_POINTS
from services.alignment.retargeting.solver.compiled import compiled


@compiled
@no_type_check
def set_turn(turn, x, y, z, c, s):
    """The rotation about a unit vector by an angle of that cosine and sine (Rodrigues)."""
    v = 1.0 - c
    turn[0, 0], turn[0, 1], turn[0, 2] = c + v * x * x, v * x * y - s * z, v * x * z + s * y
    turn[1, 0], turn[1, 1], turn[1, 2] = v * x * y + s * z, c + v * y * y, v * y * z - s * x
    turn[2, 0], turn[2, 1], turn[2, 2] = v * x * z - s * y, v * y * z + s * x, c + v * z * z


@compiled
@no_type_check
def place_joints(hand, finger, joints, origin, axis, turn):
    """Origins and axes of a finger's joints and its tip, wrist coordinates."""
    r, own = turn[0], turn[1]
    r[:] = 0.0
    r[0, 0] = r[1, 1] = r[2, 2] = 1.0
    place = origin[hand.num_joints[finger]]
    place[:] = 0.0
    last = hand.num_joints[finger]
    for joint in range(last):
        offset, fixed = hand.position_m[finger, joint], hand.rotation[finger, joint]
        is_turned = hand.is_turned[finger, joint] == 1
        kind = hand.axis_kind[finger, joint]
        x = hand.axis[finger, joint, 0]
        y = hand.axis[finger, joint, 1]
        z = hand.axis[finger, joint, 2]
        c, s = np.cos(joints[joint]), np.sin(joints[joint])
        if kind == 3:
            set_turn(own, x, y, z, c, s)
        s *= hand.axis_sign[finger, joint]
        for row in range(3):
            r0, r1, r2 = r[row, 0], r[row, 1], r[row, 2]
            place[row] += r0 * offset[0] + r1 * offset[1] + r2 * offset[2]
            origin[joint, row] = place[row]
            t0, t1, t2 = r0, r1, r2
            if is_turned:
                t0 = r0 * fixed[0, 0] + r1 * fixed[1, 0] + r2 * fixed[2, 0]
                t1 = r0 * fixed[0, 1] + r1 * fixed[1, 1] + r2 * fixed[2, 1]
                t2 = r0 * fixed[0, 2] + r1 * fixed[1, 2] + r2 * fixed[2, 2]
            axis[joint, row] = t0 * x + t1 * y + t2 * z
            if kind == 0:
                r[row, 0], r[row, 1], r[row, 2] = t0, c * t1 + s * t2, c * t2 - s * t1
            elif kind == 1:
                r[row, 0], r[row, 1], r[row, 2] = c * t0 - s * t2, t1, s * t0 + c * t2
            elif kind == 2:
                r[row, 0], r[row, 1], r[row, 2] = c * t0 + s * t1, c * t1 - s * t0, t2
            else:
                for column in range(3):
                    r[row, column] = t0 * own[0, column] + t1 * own[1, column] + t2 * own[2, column]
    tip = hand.tip_m[finger]
    for row in range(3):
        place[row] += r[row, 0] * tip[0] + r[row, 1] * tip[1] + r[row, 2] * tip[2]


@compiled
@no_type_check
def linearize(hand, person, work, finger, joints):
    """Points of the virtual finger and their slopes; a hinge moves a point by axis × lever."""
    origin, axis = work.origin[finger], work.axis[finger]
    place_joints(hand, finger, joints, origin, axis, work.turn)
    last = hand.num_joints[finger]
    point, slope, tip_slope = work.point[finger], work.slope[finger], work.tip_slope[finger]
    own = work.own_slope
    for index in range(NUM_POINTS):
        at = hand.point_joints[finger, index] if index < 3 else last
        now, before = index % 2, (index + 1) % 2
        for joint in range(last):
            if joint < at:
                ax, ay, az = axis[joint, 0], axis[joint, 1], axis[joint, 2]
                dx = origin[at, 0] - origin[joint, 0]
                dy = origin[at, 1] - origin[joint, 1]
                dz = origin[at, 2] - origin[joint, 2]
                own[now, joint, 0] = ay * dz - az * dy
                own[now, joint, 1] = az * dx - ax * dz
                own[now, joint, 2] = ax * dy - ay * dx
            else:
                own[now, joint, 0] = own[now, joint, 1] = own[now, joint, 2] = 0.0
        for k in range(3):
            if index == 0:
                travel = person.travel[finger]
                moved = origin[at, k] - hand.knuckle_m[finger, k]
                point[0, k] = person.knuckle_m[finger, k] + travel * moved
                for joint in range(last):
                    slope[0, joint, k] = travel * own[now, joint, k]
            else:
                scale = work.scale[finger, index - 1]
                base = hand.point_joints[finger, index - 1]
                point[index, k] = point[index - 1, k] + scale * (origin[at, k] - origin[base, k])
                for joint in range(last):
                    bone = own[now, joint, k] - own[before, joint, k]
                    slope[index, joint, k] = slope[index - 1, joint, k] + scale * bone
            if index == 3:
                for joint in range(last):
                    tip_slope[joint, k] = own[now, joint, k]
