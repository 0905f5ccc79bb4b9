"""URDF of a robot hand for other solvers, generated from its kinematic tables."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from typing import Final

from scipy.spatial.transform import Rotation

from dextouch.hands import CHAINS
from dextouch.hands.robot_hand import RobotHand

WRIST_LINK: Final = "wrist"
# URDF requires effort and velocity limits; neither is used here.
_EFFORT, _VELOCITY = "2", "10"


def hand_urdf(hand: RobotHand) -> str:
    """URDF of one hand: joints by their firmware names, links by `link_name`, no shapes.

    The root link is the wrist frame. Quaternions of the tables are converted to roll, pitch and
    yaw, exact to rounding.
    """
    robot = ET.Element("robot", name=f"{hand.side}_hand")
    ET.SubElement(robot, "link", name=WRIST_LINK)
    for index, finger in enumerate(hand.fingers):
        parent = WRIST_LINK
        for joint, row in enumerate(finger.joints):
            child = link_name(CHAINS[index], joint)
            element = _joint(robot, row.name, "revolute", (parent, child))
            # Angles about fixed x, then y, then z, as URDF wants them.
            R = Rotation.from_quat(row.q_wxyz, scalar_first=True)
            _origin(element, row.position_m, R.as_euler("xyz", suppress_warnings=True))
            ET.SubElement(element, "axis", xyz=_text(row.axis))
            low, high = row.limits_rad
            limit = ET.SubElement(element, "limit", effort=_EFFORT, velocity=_VELOCITY)
            limit.set("lower", repr(float(low)))
            limit.set("upper", repr(float(high)))
            parent = child
        tip = tip_name(CHAINS[index])
        _origin(_joint(robot, f"{tip}_mount", "fixed", (parent, tip)), finger.tip_m, (0.0,) * 3)
    return ET.tostring(robot, encoding="unicode")


def link_name(chain: str, joint: int) -> str:
    """The link that a joint of a chain moves; its origin is the joint's."""
    return f"{chain}_{joint}"


def tip_name(chain: str) -> str:
    """The link at a fingertip."""
    return f"{chain}_tip"


def _joint(robot: ET.Element, name: str, kind: str, links: tuple[str, str]) -> ET.Element:
    parent, child = links
    ET.SubElement(robot, "link", name=child)
    element = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    return element


def _origin(element: ET.Element, xyz: Iterable[float], rpy: Iterable[float]) -> None:
    ET.SubElement(element, "origin", xyz=_text(xyz), rpy=_text(rpy))


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
