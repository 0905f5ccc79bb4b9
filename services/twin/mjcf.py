"""MJCF generation of the scene: table, two hands with tactile skin, and a task's objects."""

from collections.abc import Iterable

import numpy as np

from dextouch.tactile.layout import FINGERS
from services.twin.hands import PALM_THICKNESS_M, TwinHand

PHYSICS_RATE_HZ = 600  # a multiple of the rates of all devices
# Wrist impedance of the arm (or the operator's arm) towards the commanded pose.
WRIST_STIFFNESS_N_M, WRIST_DAMPING_N_S_M = 700.0, 40.0
WRIST_STIFFNESS_NM_RAD, WRIST_DAMPING_NM_S_RAD = 15.0, 0.4
FINGER_STIFFNESS_NM_RAD, FINGER_DAMPING_NM_S_RAD, FINGER_TORQUE_NM = 1.2, 0.03, 2.0
# Human skin and the robot's pads yield about 1 mm at 10 N.
_HAND_CONTACT = 'friction="1.2 0.01 0.0005" solref="0.02 1" solimp="0.4 0.8 0.004" priority="1"'
_OBJECT_CONTACT = 'friction="1 0.005 0.0001"'
_HAND_COLOURS = {"left": (0.45, 0.62, 0.88), "right": (0.90, 0.66, 0.50)}
_SKIN_GROUP = 4


def numbers(values: Iterable[float]) -> str:
    """Format numbers as an MJCF attribute, without loss."""
    return " ".join(repr(float(value)) for value in values)


def _tint(side: str, finger_index: int) -> str:
    """Colour of a hand, lighter from thumb to little finger."""
    base = np.array(_HAND_COLOURS[side])
    return numbers([*(base * (0.80 + 0.06 * finger_index)).clip(0, 1), 1.0])


def _finger(hand: TwinHand, index: int) -> str:
    table = hand.kinematics.fingers[index]
    straight_m, _ = hand.distal_m(index)
    tip = np.array(table.tip_m)
    ends = [
        np.zeros(3),
        np.array(table.joints[2].position_m),
        np.array(table.joints[3].position_m),
        tip / np.linalg.norm(tip) * straight_m,
    ]
    prefix = f"{hand.side}_{FINGERS[index]}"
    rgba = _tint(hand.side, index)
    parts = []
    for link, row in enumerate(table.joints):
        parts.append(
            f'<body name="{prefix}_{link}" pos="{numbers(row.position_m)}" '
            f'quat="{numbers(row.q_wxyz)}" gravcomp="1"><joint name="{row.name}" class="finger" '
            f'axis="{numbers(row.axis)}" range="{numbers(row.limits_rad)}"/>'
        )
        if link == 0:
            parts.append('<inertial mass="0.01" pos="0 0 0" diaginertia="1e-6 1e-6 1e-6"/>')
        else:
            radius = hand.shape.radii_m[index][link - 1]
            parts.append(
                f'<geom name="{prefix}_link{link}" class="hand" type="capsule" '
                f'fromto="0 0 0 {numbers(ends[link])}" size="{radius!r}" rgba="{rgba}"/>'
            )
    parts.append(_skin(f"{prefix}_skin"))
    return "".join(parts) + "</body>" * len(table.joints)


def _skin(name: str) -> str:
    return (
        f'<geom name="{name}" type="mesh" mesh="{name}" contype="0" conaffinity="0" mass="0" '
        f'group="{_SKIN_GROUP}" rgba="0 0 0 0"/>'
    )


def _hand(hand: TwinHand) -> str:
    side, shape = hand.side, hand.shape
    half = (0.040, 0.5 * PALM_THICKNESS_M, 0.045)
    centre = hand.palm_centre_m - np.array([0.0, hand.palm_sign * half[1], 0.0])
    fingers = "".join(_finger(hand, index) for index in range(len(FINGERS)))
    forearm_z = shape.palm_z_m + half[2]
    return (
        f'<body name="{side}_wrist" gravcomp="1"><freejoint name="{side}_free"/>'
        '<inertial mass="0.45" pos="0 0 -0.03" diaginertia="8e-4 1e-3 6e-4"/>'
        f'<geom name="{side}_palm" class="hand" type="box" pos="{numbers(centre)}" '
        f'size="{numbers(half)}" rgba="{_tint(side, 1)}"/>'
        f'<geom name="{side}_forearm" class="hand" type="capsule" size="0.026" '
        f'fromto="0 0 {forearm_z + 0.02!r} 0 0 {forearm_z + 0.06!r}" '
        f'contype="0" conaffinity="0" mass="0" rgba="{_tint(side, 0)}"/>'
        f'<site name="{side}_wrist_site"/>{_skin(f"{side}_palm_skin")}{fingers}</body>'
        f'<body name="{side}_target" mocap="true"><site name="{side}_target_site"/></body>'
    )


def _grid_mesh(name: str, grid_m: np.ndarray, *, flip: bool) -> str:
    """Mesh of an open surface through a grid of points [rows, columns, 3]."""
    rows, columns, _ = grid_m.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, :-1].ravel(), index[1:, 1:].ravel()
    triangles = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    if flip:
        triangles = triangles[:, ::-1]
    faces = " ".join(str(int(corner)) for corner in triangles.ravel())
    return (
        f'<mesh name="{name}" inertia="shell" vertex="{numbers(grid_m.ravel())}" face="{faces}"/>'
    )


def _meshes(hand: TwinHand) -> str:
    flip = hand.side == "left"
    tips = [
        _grid_mesh(f"{hand.side}_{finger}_skin", hand.tip_skin_m(index), flip=flip)
        for index, finger in enumerate(FINGERS)
    ]
    return "".join(tips) + _grid_mesh(f"{hand.side}_palm_skin", hand.palm_skin_m(), flip=flip)


def _actuators(hand: TwinHand) -> str:
    parts = [
        f'<position name="{name}" joint="{name}" kp="{FINGER_STIFFNESS_NM_RAD}" '
        f'kv="{FINGER_DAMPING_NM_S_RAD}" forcerange="-{FINGER_TORQUE_NM} {FINGER_TORQUE_NM}"/>'
        for name in hand.kinematics.joint_names
    ]
    for axis in range(6):
        gear = " ".join("1" if axis == position else "0" for position in range(6))
        stiffness = WRIST_STIFFNESS_N_M if axis < 3 else WRIST_STIFFNESS_NM_RAD
        damping = WRIST_DAMPING_N_S_M if axis < 3 else WRIST_DAMPING_NM_S_RAD
        parts.append(
            f'<position name="{hand.side}_wrist_{axis}" site="{hand.side}_wrist_site" '
            f'refsite="{hand.side}_target_site" gear="{gear}" kp="{stiffness}" kv="{damping}"/>'
        )
    return "".join(parts)


def _sensors(hand: TwinHand) -> str:
    return "".join(
        f'<tactile name="{hand.side}_{pad}" geom="{hand.side}_{pad}_skin" '
        f'mesh="{hand.side}_{pad}_skin"/>'
        for pad in (*FINGERS, "palm")
    )


def scene_xml(hands: tuple[TwinHand, ...], objects: str) -> str:
    """MJCF of table, shelf behind the viewer for removed objects, hands (left first) and objects.

    `objects` are MJCF bodies with geoms of class "object".
    """
    bodies = "".join(_hand(hand) for hand in hands)
    return (
        '<mujoco model="dextouch_twin"><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="{1 / PHYSICS_RATE_HZ!r}" cone="elliptic" impratio="10" '
        'integrator="implicitfast" solver="Newton"><flag autoreset="disable"/></option>'
        '<size memory="64M"/>'
        '<default><default class="hand"><geom contype="1" conaffinity="2" density="1100" '
        f'condim="4" {_HAND_CONTACT}/></default>'
        f'<default class="object"><geom contype="2" conaffinity="3" condim="4" {_OBJECT_CONTACT}/>'
        '</default><default class="finger"><joint type="hinge" armature="0.0005" damping="0.01"/>'
        f"</default></default><asset>{''.join(_meshes(hand) for hand in hands)}</asset><worldbody>"
        '<geom name="table" class="object" type="box" pos="0 0 -0.02" size="0.7 0.5 0.02" '
        'rgba="0.72 0.66 0.58 1"/>'
        '<geom name="shelf" class="object" type="box" pos="0 -3 -0.02" size="0.7 0.5 0.02"/>'
        f'<body name="head_target" mocap="true"/>{bodies}{objects}</worldbody>'
        f"<actuator>{''.join(_actuators(hand) for hand in hands)}</actuator>"
        f"<sensor>{''.join(_sensors(hand) for hand in hands)}</sensor></mujoco>"
    )
