"""URDF model reader: links with their joints (https://wiki.ros.org/urdf/XML).

Defaults follow the format: origin zero, axis x, lower and upper limit zero.
"""

from typing import Final

import numpy as np

from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.finger_table import Vector3
from dextouch.hands.hand_files.elements import Element
from dextouch.hands.hand_files.model_file import Joint, Link, unit_axis

_TYPES: Final = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


class UrdfModel:
    """The links of a URDF.

    Args:
        root: the `robot` element.

    Raises:
        InvalidInputError: not a tree (duplicate names, unknown links, a link with two parents), or
            unprocessed xacro.
    """

    def __init__(self, root: Element) -> None:
        self.source = root.source.rpartition(" line ")[0]
        self.sites: tuple[str, ...] = ()
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
            self._hang(joint)

    def _hang(self, joint: Element) -> None:
        parent, child = self._end(joint, "parent"), self._end(joint, "child")
        if child in self._joints:
            raise joint.refusal(
                f"got link {child!r} as child, but joint {self._joints[child].text('name')!r} "
                "already moves it; expected a tree"
            )
        self.parents[child] = parent
        self._joints[child] = joint

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
        """A link with the joint that moves it.

        Raises:
            InvalidInputError: invalid numbers, or a zero axis.
        """
        element = self._joints.get(name)
        if element is None:
            return Link(np.eye(4), ())
        T_parent_link = _origin(element)
        element.text("type")
        kind = element.choice("type", *_TYPES)
        if kind == "fixed":
            return Link(T_parent_link, ())
        joint = Joint(element.text("name"), str(element))
        if element.child("mimic") is not None:
            return Link(T_parent_link, (joint._replace(refusal="it mimics another joint"),))
        if kind != "revolute":
            return Link(T_parent_link, (joint._replace(refusal=f"its type is {kind!r}"),))
        joint = joint._replace(axis=_axis(element), limits_rad=_limits(element))
        return Link(T_parent_link, (joint,))

    def site(self, name: str) -> tuple[str, np.ndarray]:
        """URDF has no sites.

        Raises:
            KeyError: always.
        """
        raise KeyError(name)


def _three(element: Element, name: str, default: Vector3) -> np.ndarray:
    values = element.numbers(name, 3)
    return np.array(default if values is None else values)


def _origin(joint: Element) -> np.ndarray:
    origin = joint.child("origin")
    if origin is None:
        return np.eye(4)
    zeros = (0.0, 0.0, 0.0)
    roll, pitch, yaw = _three(origin, "rpy", zeros)
    turns = [[roll, 0, 0], [0, pitch, 0], [0, 0, yaw]]
    # Extrinsic rotations: about x, then y, then z.
    R_x, R_y, R_z = rotation_from_vector(np.array(turns, dtype=np.float64))
    return transform(R_z @ R_y @ R_x, _three(origin, "xyz", zeros))


def _axis(joint: Element) -> Vector3:
    element = joint.child("axis")
    axis = np.array([1.0, 0, 0]) if element is None else _three(element, "xyz", (1.0, 0.0, 0.0))
    return unit_axis(axis, joint)


def _limits(joint: Element) -> tuple[float, float] | None:
    limit = joint.child("limit")
    if limit is None:
        return None
    lower, upper = limit.numbers("lower", 1) or (0.0,), limit.numbers("upper", 1) or (0.0,)
    return lower[0], upper[0]
