"""Links and joints of a hand's model, and their reader for URDF (https://wiki.ros.org/urdf/XML).

Defaults follow the format: origin zero, axis x, lower and upper limit zero.
"""

from typing import Final, NamedTuple

import numpy as np

from dextouch.errors import UnknownNameError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.hand_files.elements import Element
from dextouch.hands.robot_hand import Vector3

_TYPES: Final = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


def vector3(values: np.ndarray) -> Vector3:
    """An array of three numbers as a tuple."""
    x, y, z = values.tolist()
    return x, y, z


def unit_axis(axis: np.ndarray, joint: Element) -> Vector3:
    """The direction of a joint's axis, which must not be zero."""
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
    joints: tuple[Joint, ...] = ()


class UrdfModel:
    """The links of a URDF, which must be a tree without unprocessed xacro.

    Links are read when asked for, so that only those of fingers must be valid.
    """

    def __init__(self, root: Element) -> None:
        self.source = root.source.rpartition(" line ")[0]
        self.parents: dict[str, str | None] = {}
        self._joints: dict[str, Element] = {}
        for child in root.children:
            if child.tag.startswith("xacro:"):
                raise child.refusal("got xacro; run it first and load the URDF that it prints")
        for link in root.each("link"):
            if link.text("name") in self.parents:
                raise link.refusal("got this link twice; names must differ")
            self.parents[link.text("name")] = None
        names: set[str] = set()
        for joint in root.each("joint"):
            if joint.text("name") in names:
                raise joint.refusal("got this joint twice; names must differ")
            names.add(joint.text("name"))
            parent, child_name = self._end(joint, "parent"), self._end(joint, "child")
            if child_name in self._joints:
                raise joint.refusal(
                    f"got link {child_name!r} as child, but joint "
                    f"{self._joints[child_name].text('name')!r} already moves it; expected a tree"
                )
            self.parents[child_name] = parent
            self._joints[child_name] = joint

    def _end(self, joint: Element, tag: str) -> str:
        end = joint.child(tag)
        if end is None:
            raise joint.refusal(f"got no <{tag}>, expected one")
        if end.text("link") not in self.parents:
            raise joint.refusal(
                f"got {tag} link {end.text('link')!r}, which the file does not have"
            )
        return end.text("link")

    def link(self, name: str) -> Link:
        """A link with the joint that moves it."""
        element = self._joints.get(name)
        if element is None:
            return Link(np.eye(4))
        T_parent_link = _origin(element)
        element.text("type")
        kind = element.choice("type", *_TYPES)
        if kind == "fixed":
            return Link(T_parent_link)
        joint = Joint(element.text("name"), str(element))
        if element.child("mimic") is not None:
            joint = joint._replace(refusal="it mimics another joint")
        elif kind != "revolute":
            joint = joint._replace(refusal=f"its type is {kind!r}")
        else:
            joint = joint._replace(axis=_axis(element), limits_rad=_limits(element))
        return Link(T_parent_link, (joint,))

    def site(self, name: str, where: str) -> tuple[str, np.ndarray]:
        """URDF has no sites."""
        raise UnknownNameError(f"site in {where}:", name, [])


def _origin(joint: Element) -> np.ndarray:
    origin = joint.child("origin")
    if origin is None:
        return np.eye(4)
    turns = np.diag(origin.numbers("rpy", 0.0, 0.0, 0.0))
    # Extrinsic rotations: about x, then y, then z.
    R_x, R_y, R_z = rotation_from_vector(turns)
    return transform(R_z @ R_y @ R_x, np.array(origin.numbers("xyz", 0.0, 0.0, 0.0)))


def _axis(joint: Element) -> Vector3:
    element = joint.child("axis")
    axis = (1.0, 0.0, 0.0) if element is None else element.numbers("xyz", 1.0, 0.0, 0.0)
    return unit_axis(np.array(axis), joint)


def _limits(joint: Element) -> tuple[float, float] | None:
    limit = joint.child("limit")
    if limit is None:
        return None
    return limit.numbers("lower", 0.0)[0], limit.numbers("upper", 0.0)[0]
