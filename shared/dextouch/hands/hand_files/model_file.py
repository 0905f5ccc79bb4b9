"""What URDF and MJCF models consist of: a tree of links with joints."""

from typing import NamedTuple

import numpy as np

from dextouch.hands.finger_table import Vector3
from dextouch.hands.hand_files.elements import Element


def vector3(values: np.ndarray) -> Vector3:
    """An array of three numbers as a tuple."""
    x, y, z = values.tolist()
    return x, y, z


def unit_axis(axis: np.ndarray, joint: Element) -> Vector3:
    """The direction of a joint's axis.

    Raises:
        InvalidInputError: an axis of zeros.
    """
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise joint.refusal(f"got axis {axis.tolist()}, expected a direction")
    return vector3(axis / length)


class Joint(NamedTuple):
    """A joint in the frame of its link.

    Attributes:
        name: in the model.
        where: prefix of error messages.
        anchor_m: a point of its axis in the link's frame.
        axis: unit vector in the link's frame.
        limits_rad: lower and upper limit; None if it is not a limited hinge.
        zero_rad: joint angle of the file's reference pose.
        refusal: why a finger cannot contain this joint; None if it can.
    """

    name: str
    where: str
    anchor_m: Vector3 = (0.0, 0.0, 0.0)
    axis: Vector3 = (0.0, 0.0, 1.0)
    limits_rad: tuple[float, float] | None = None
    zero_rad: float = 0.0
    refusal: str | None = None


class Link(NamedTuple):
    """A link: T_parent_link [4, 4] in the reference pose, and its joints in order."""

    T_parent_link: np.ndarray
    joints: tuple[Joint, ...]
