"""Kinematic tables of the human hand: mean bone lengths and joint limits.

Adult mean bone lengths (Buryanov and Kotiuk 2010; phalanges with the pulp added to the last one).
Positions of the wrist bones and the limits are our estimates from common anatomy. The thumb's base
frame is oriented like the robot's, so that flexion and abduction have the same meaning.
"""

from typing import Final

import numpy as np

from dextouch.hands import FingerTable, JointRow, Quaternion, Vector3

# Base of each finger's metacarpal in the right wrist frame, metres.
METACARPAL_BASES_M: Final[dict[str, np.ndarray]] = {
    "index": np.array([0.013, -0.002, -0.027]),
    "middle": np.array([0.003, -0.004, -0.029]),
    "ring": np.array([-0.007, -0.003, -0.027]),
    "little": np.array([-0.015, 0.000, -0.024]),
}
# Length of the metacarpal, and its lean to the thumb side.
_METACARPALS: Final = {
    "index": (0.06812, 0.14),
    "middle": (0.06460, 0.00),
    "ring": (0.05800, -0.13),
    "little": (0.05369, -0.26),
}
# Proximal, middle, and distal phalanx with pulp, metres.
_PHALANGES_M: Final = {
    "index": (0.03978, 0.02238, 0.01966),
    "middle": (0.04463, 0.02633, 0.02135),
    "ring": (0.04137, 0.02565, 0.02125),
    "little": (0.03274, 0.01811, 0.01969),
}
_FINGER_LIMITS_RAD: Final = ((-0.5, 1.57), (-0.35, 0.35), (0.0, 1.92), (0.0, 1.40))
_THUMB_BASE_M: Final = (0.018, 0.007, -0.020)
_THUMB_BONES_M: Final = (0.04622, 0.03157, 0.02734)
_THUMB_LIMITS_RAD: Final = ((-1.0, 1.2), (-1.4, 0.6), (-0.5, 1.3), (-0.5, 1.5))
_THUMB_BASE_TURN: Final = (0.6294, -0.0606, -0.7201, 0.2856)
_THUMB_SADDLE_TURN: Final = (0.9347, 0.0919, 0.3425, -0.0234)
_THUMB_ROLL: Final = (0.9591, -0.0122, 0.0419, 0.2796)
_NO_TURN: Final = (1.0, 0.0, 0.0, 0.0)
# As on the robot: the abduction hinge is the knuckle, the two flexions after it PIP and DIP.
_POINTS: Final = (1, 2, 3)


def _finger(name: str) -> FingerTable:
    length, lean = _METACARPALS[name]
    base = METACARPAL_BASES_M[name]
    knuckle = base + length * np.array([np.sin(lean), 0.0, -np.cos(lean)])
    proximal, middle, distal = _PHALANGES_M[name]
    # The finger spreads half as much as its metacarpal, by a rotation about y.
    fan = (float(np.cos(lean / 4)), 0.0, float(-np.sin(lean / 4)), 0.0)
    firmware = "pinky" if name == "little" else f"{name}_finger"
    flex, abd, pip, dip = _FINGER_LIMITS_RAD
    x_axis, y_axis = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    place: Vector3 = (float(knuckle[0]), float(knuckle[1]), float(knuckle[2]))
    return FingerTable(
        name,
        (
            JointRow(f"r_{firmware}_mcp_flex", place, fan, x_axis, flex),
            JointRow(f"r_{firmware}_mcp_abd", (0.0, 0.0, 0.0), _NO_TURN, y_axis, abd),
            JointRow(f"r_{firmware}_pip", (0.0, 0.0, -proximal), _NO_TURN, x_axis, pip),
            JointRow(f"r_{firmware}_dip", (0.0, 0.0, -middle), _NO_TURN, x_axis, dip),
        ),
        (0.0, 0.0, -distal),
        _POINTS,
    )


def _thumb() -> FingerTable:
    metacarpal, proximal, distal = _THUMB_BONES_M
    flex, abd, mcp, ip = _THUMB_LIMITS_RAD
    x_axis, y_axis = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    return FingerTable(
        "thumb",
        (
            JointRow("r_thumb_cmc_flex", _THUMB_BASE_M, _THUMB_BASE_TURN, x_axis, flex),
            JointRow("r_thumb_cmc_abd", (0.0, 0.0, 0.0), _THUMB_SADDLE_TURN, y_axis, abd),
            JointRow("r_thumb_mcp", (0.0, 0.0, -metacarpal), _THUMB_ROLL, x_axis, mcp),
            JointRow("r_thumb_ip", (0.0, 0.0, -proximal), _NO_TURN, x_axis, ip),
        ),
        (0.0, 0.0, -distal),
        _POINTS,
    )


def _mirrored(row: JointRow) -> JointRow:
    """Mirror a row to the left hand: y positions and rotations about x and z change sign."""
    x, y, z = row.position_m
    qw, qx, qy, qz = row.q_wxyz
    axis_x, axis_y, axis_z = row.axis
    q: Quaternion = (qw, -qx, qy, -qz)
    name = f"l_{row.name.removeprefix('r_')}"
    return JointRow(name, (x, -y, z), q, (-axis_x, axis_y, -axis_z), row.limits_rad)


def human_fingers(side: str) -> tuple[FingerTable, ...]:
    """Finger tables, thumb … little, of a "left" or "right" human hand."""
    right = (_thumb(), *(_finger(name) for name in METACARPAL_BASES_M))
    if side == "right":
        return right
    mirrored = []
    for finger in right:
        rows = tuple(_mirrored(row) for row in finger.joints)
        x, y, z = finger.tip_m
        mirrored.append(FingerTable(finger.chain, rows, (x, -y, z), finger.points))
    return tuple(mirrored)
