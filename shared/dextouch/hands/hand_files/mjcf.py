"""Reader of bodies with their joints and sites from MJCF.

https://mujoco.readthedocs.io/en/stable/XMLreference.html. A body may have several joints, each with
its own anchor; `frame` elements transform their children.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from dextouch.errors import DegenerateRotationError, UnknownNameError
from dextouch.geometry import apply, transform
from dextouch.geometry.rotations import rotation_from_quaternion, rotation_from_vector
from dextouch.hands.hand_files.elements import Element
from dextouch.hands.hand_files.urdf import Joint, Link, unit_axis, vector3

WORLD: Final = "world"
MAIN_CLASS: Final = "main"
ORIENTATIONS: Final = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
# Elements that import bodies from elsewhere: the file must contain the whole model.
_FOREIGN: Final = ("include", "attach", "replicate", "composite", "flexcomp")
_TINY: Final = 1e-9


class _ElementLocation(NamedTuple):
    """An element with its body, T_body_parent of the enclosing frames, and its default class."""

    element: Element
    body: str
    T_body_parent: np.ndarray
    class_name: str


class MjcfModel:
    """The bodies of an MJCF file that includes no other file and has MuJoCo generate nothing."""

    def __init__(self, root: Element) -> None:
        self.source = root.source.rpartition(" line ")[0]
        self.parents: dict[str, str | None] = {WORLD: None}
        self._settings = _Settings(root)
        self._bodies: dict[str, _ElementLocation] = {}
        self._joints: dict[str, list[_ElementLocation]] = {WORLD: []}
        self._sites: dict[str, _ElementLocation] = {}
        self._coupled = {
            name
            for equality in root.each("equality")
            for joint in equality.each("joint")
            if joint.attributes.get("active", "true") == "true"
            for name in (joint.attributes.get("joint1"), joint.attributes.get("joint2"))
        }
        for child in root.each("include"):
            raise child.refusal(_flatten("include"))
        # An explicit stack instead of recursion, since files may be deeply nested.
        waiting = [
            _ElementLocation(child, WORLD, np.eye(4), MAIN_CLASS)
            for child in root.each("worldbody")
        ]
        while waiting:
            self._read_children(waiting.pop(), waiting)

    def _read_children(self, place: _ElementLocation, waiting: list[_ElementLocation]) -> None:
        class_name = place.element.attributes.get("childclass", place.class_name)
        for child in place.element.children:
            inner = _ElementLocation(child, place.body, place.T_body_parent, class_name)
            match child.tag:
                case "body":
                    waiting.append(self._read_body(inner))
                case "frame":
                    T_body_frame = place.T_body_parent @ self._settings.frame(child)
                    self._read_children(inner._replace(T_body_parent=T_body_frame), waiting)
                case "joint" | "freejoint":
                    self._joints[place.body].append(inner)
                case "site" if child.attributes.get("name"):
                    _add(self._sites, child.text("name"), inner)
                case tag if tag in _FOREIGN:
                    raise child.refusal(_flatten(tag))

    def _read_body(self, place: _ElementLocation) -> _ElementLocation:
        # An unnamed body cannot be named in the mapping, but fingers may pass through it.
        name = place.element.attributes.get("name") or f"unnamed body at {place.element.source}"
        if name == WORLD:
            raise place.element.refusal(f"got the reserved name {WORLD!r}")
        # Two unnamed bodies on one line must stay distinct.
        while name in self.parents and not place.element.attributes.get("name"):
            name += "'"
        _add(self._bodies, name, place)
        self.parents[name] = place.body
        self._joints[name] = []
        return _ElementLocation(place.element, name, np.eye(4), place.class_name)

    def link(self, name: str) -> Link:
        """A body with its joints."""
        if name == WORLD:
            return Link(np.eye(4))
        place = self._bodies[name]
        T_parent_body = place.T_body_parent @ self._settings.frame(place.element)
        return Link(T_parent_body, tuple(self._joint(joint) for joint in self._joints[name]))

    def site(self, name: str, where: str) -> tuple[str, np.ndarray]:
        """The body of a site and T_body_site [4, 4]; `fromto` is refused."""
        if name not in self._sites:
            raise UnknownNameError(f"site in {where}:", name, list(self._sites))
        place = self._sites[name]
        element = self._settings.with_defaults(place)
        if "fromto" in element.attributes:
            raise element.refusal("got fromto, expected pos; name a body and an offset_m instead")
        return place.body, place.T_body_parent @ self._settings.frame(element)

    def _joint(self, place: _ElementLocation) -> Joint:
        element = self._settings.with_defaults(place)
        joint = Joint(element.attributes.get("name", ""), str(element))
        is_free = element.tag == "freejoint"
        kind = "free" if is_free else element.attributes.get("type", "hinge")
        if kind != "hinge":
            return joint._replace(refusal=f"its type is {kind!r}")
        if joint.name in self._coupled:
            return joint._replace(refusal="an equality constraint couples it to another joint")
        T = place.T_body_parent
        anchor = apply(T, np.array([element.numbers("pos", 0.0, 0.0, 0.0)]))[0]
        axis = T[:3, :3] @ np.array(element.numbers("axis", 0.0, 0.0, 1.0))
        return joint._replace(
            anchor_m=vector3(anchor),
            axis=unit_axis(axis, element),
            limits_rad=self._limits(element),
            zero_rad=element.numbers("ref", 0.0)[0] * self._settings.radians_per_unit,
        )

    def _limits(self, joint: Element) -> tuple[float, float] | None:
        lower, upper = np.array(joint.numbers("range", 0.0, 0.0)) * self._settings.radians_per_unit
        limited = joint.choice("limited", "auto", "true", "false")
        if limited == "false" or "range" not in joint.attributes:
            return None
        if limited == "auto" and not self._settings.has_auto_limits:
            raise joint.refusal("got a range but autolimits is off; say limited='true' or 'false'")
        return float(lower), float(upper)


def _add(places: dict[str, _ElementLocation], name: str, place: _ElementLocation) -> None:
    if name in places:
        raise place.element.refusal(
            f"got this name twice, first in {places[name].element.source}; names must differ"
        )
    places[name] = place


def _flatten(tag: str) -> str:
    return (
        f"got <{tag}>, expected one whole file; load the model in MuJoCo and save it with "
        "mujoco.mj_saveLastXML"
    )


class _Settings:
    """Units, default classes and Euler axes, which affect the meaning of the bodies' attributes."""

    def __init__(self, root: Element) -> None:
        compiler = Element("compiler", {}, root.source)
        for element in root.each("compiler"):
            compiler = replace(element, attributes={**compiler.attributes, **element.attributes})
        degrees = compiler.choice("angle", "degree", "radian") == "degree"
        self.radians_per_unit = float(np.pi / 180) if degrees else 1.0
        self.has_auto_limits = compiler.choice("autolimits", "true", "false") == "true"
        compiler.choice("coordinate", "local")
        self._axes = compiler.attributes.get("eulerseq", "xyz")
        if len(self._axes) != 3 or self._axes.lower().strip("xyz"):
            raise compiler.refusal(f"got eulerseq={self._axes!r}, expected three of x y z X Y Z")
        self._classes: dict[str, dict[str, dict[str, str]]] = {MAIN_CLASS: {}}
        for element in root.each("default"):
            self._read_class(element, element.attributes.get("class", MAIN_CLASS), {})

    def _read_class(
        self, element: Element, name: str, inherited: Mapping[str, dict[str, str]]
    ) -> None:
        # The main class may appear in several sections, every other one only once.
        tags = {**inherited, **self._classes.get(name, {})}
        for child in element.children:
            if child.tag != "default":
                tags[child.tag] = {**tags.get(child.tag, {}), **child.attributes}
        self._classes[name] = tags
        for child in element.each("default"):
            nested = child.text("class")
            if nested in self._classes:
                raise child.refusal(f"got class {nested!r} twice; names must differ")
            self._read_class(child, nested, tags)

    def with_defaults(self, place: _ElementLocation) -> Element:
        """A place's element with the defaults of its class."""
        element = place.element
        name = element.attributes.get("class", place.class_name)
        if name not in self._classes:
            raise UnknownNameError(f"class in {element}:", name, list(self._classes))
        defaults = self._classes[name].get(element.tag, {})
        return replace(element, attributes={**defaults, **element.attributes})

    def frame(self, element: Element) -> np.ndarray:
        """T_parent_element [4, 4] of a body, frame or site: `pos` and one kind of orientation."""
        position = element.numbers("pos", 0.0, 0.0, 0.0)
        kinds = [kind for kind in ORIENTATIONS if kind in element.attributes]
        if len(kinds) > 1:
            raise element.refusal(f"got {' and '.join(kinds)}, expected one orientation")
        if not kinds:
            return transform(np.eye(3), np.array(position))
        values = np.array(element.numbers(kinds[0], *[0.0] * ORIENTATIONS[kinds[0]]))
        with suppress(DegenerateRotationError):
            return transform(self._rotation(kinds[0], values), np.array(position))
        raise element.refusal(f"got {kinds[0]}={values.tolist()}, which is not a rotation")

    def _rotation(self, kind: str, values: np.ndarray) -> np.ndarray:
        if kind == "quat":
            return rotation_from_quaternion(values)
        if kind == "axisangle":
            return rotation_from_vector(_unit(values[:3]) * values[3] * self.radians_per_unit)
        if kind == "xyaxes":
            x = _unit(values[:3])
            y = _unit(values[3:] - (values[3:] @ x) * x)
            return np.stack([x, y, np.cross(x, y)], axis=-1)
        if kind == "zaxis":
            # The smallest rotation of z to the given direction; a half turn is about x.
            z = _unit(values)
            across = np.cross([0.0, 0.0, 1.0], z)
            axis = np.array([1.0, 0, 0]) if np.linalg.norm(across) < _TINY else _unit(across)
            return rotation_from_vector(np.arctan2(np.hypot(z[0], z[1]), z[2]) * axis)
        R = np.eye(3)
        for letter, angle in zip(self._axes, values * self.radians_per_unit, strict=True):
            turn = rotation_from_vector(angle * np.eye(3)["xyz".index(letter.lower())])
            # Lower case means intrinsic, upper case extrinsic rotations.
            R = R @ turn if letter.islower() else turn @ R
        return R


def _unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    if length < _TINY:
        raise DegenerateRotationError(f"direction: got {vector.tolist()}, expected not zero")
    return np.asarray(vector / length)
