"""Links and joints of hand models in URDF and MJCF, read from XML with source locations.

Document type declarations, and with them every entity, are refused; depth and number of elements
are limited. Defaults follow https://wiki.ros.org/urdf/XML and
https://mujoco.readthedocs.io/en/stable/XMLreference.html.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple
from xml.parsers import expat

import numpy as np

from dextouch.data_folder import read_bounded
from dextouch.errors import (
    DegenerateRotationError,
    InvalidInputError,
    LimitExceededError,
    UnknownNameError,
)
from dextouch.geometry import apply, transform
from dextouch.geometry.rotations import rotation_from_quaternion, rotation_from_vector
from dextouch.hands.robot_hand import Vector3

MAX_BYTES: Final = 8 * 2**20  # chosen: of text; meshes are not read
MAX_DEPTH: Final = 100  # chosen: hands nest far fewer bodies
MAX_ELEMENTS: Final = 20_000  # chosen: hands have far fewer
# Far above any length, angle or direction, yet sums and products stay finite.
MAX_NUMBER: Final = 1e6
# float() also accepts "nan", "inf", "1_0" and digits of other scripts.
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_TYPES: Final = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
WORLD: Final = "world"
MAIN_CLASS: Final = "main"
ORIENTATIONS: Final = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
# Elements that import bodies from elsewhere: the file must contain the whole model.
_FOREIGN: Final = ("include", "attach", "replicate", "composite", "flexcomp")
_TINY: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Element:
    """One XML element; what it lacks or holds wrongly raises InvalidInputError with its place."""

    tag: str
    attributes: dict[str, str]
    source: str
    children: list["Element"] = field(default_factory=list, repr=False)

    def __str__(self) -> str:
        name = self.attributes.get("name")
        return f"{self.source}: <{self.tag}{f' name={name!r}' if name else ''}>"

    def refusal(self, message: str) -> InvalidInputError:
        """An error about this element, to be raised."""
        return InvalidInputError(f"{self}: {message}", element=self.tag)

    def each(self, *tags: str) -> Iterator["Element"]:
        """Iterate over children with these tags."""
        return (child for child in self.children if child.tag in tags)

    def child(self, tag: str) -> "Element | None":
        """The only child with that tag, or None."""
        found = list(self.each(tag))
        if len(found) > 1:
            raise self.refusal(f"got {len(found)} <{tag}>, expected at most one")
        return found[0] if found else None

    def text(self, name: str) -> str:
        """A required attribute, not empty."""
        value = self.attributes.get(name)
        if not value:
            raise self.refusal(f"got no {name!r}, expected one; name it in the model")
        return value

    def choice(self, name: str, *valid: str) -> str:
        """An attribute with a fixed set of values; the first one is the default."""
        value = self.attributes.get(name, valid[0])
        if value not in valid:
            raise UnknownNameError(f"value of {name!r} in {self}:", value, list(valid))
        return value

    def numbers(self, name: str, *defaults: float) -> tuple[float, ...]:
        """An attribute of as many finite numbers as there are defaults."""
        text = self.attributes.get(name)
        if text is None:
            return defaults
        words = text.split()
        if len(words) == len(defaults) and all(_NUMBER.fullmatch(word) for word in words):
            values = tuple(float(word) for word in words)
            if all(abs(value) <= MAX_NUMBER for value in values):
                return values
        raise self.refusal(
            f"got {name}={text[:80]!r}, expected {len(defaults)} finite numbers of at most "
            f"{MAX_NUMBER:g}"
        )


def read_elements(path: Path) -> Element:
    """Read an XML file of at most 8 MiB, 100 levels and 20 000 elements; returns the root."""
    parser = expat.ParserCreate()
    document = Element("", {}, path.name)
    ancestors = [document]
    count = 0

    def line() -> str:
        return f"{path.name} line {parser.CurrentLineNumber}"

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(ancestors) > MAX_DEPTH or count > MAX_ELEMENTS:
            raise LimitExceededError(
                f"{line()}: got more than {MAX_DEPTH} nested or {MAX_ELEMENTS} XML elements"
            )
        ancestors[-1].children.append(Element(tag, attributes, line()))
        ancestors.append(ancestors[-1].children[-1])

    def doctype(*_: object) -> None:
        raise InvalidInputError(
            f"{line()}: got a document type; entities are never read, remove the declaration"
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: ancestors.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        data = read_bounded(path, MAX_BYTES, hint="; meshes belong into files of their own")
        parser.Parse(data, True)  # noqa: FBT003 - takes no keywords
    except expat.ExpatError as error:
        raise InvalidInputError(
            f"{path.name} line {error.lineno}: got invalid XML "
            f"({expat.ErrorString(error.code)}); is the file complete?"
        ) from error
    except (ValueError, LookupError) as error:
        raise InvalidInputError(f"{path.name}: got an unknown text encoding: {error}") from error
    return document.children[0]


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
    """The links of a URDF, a tree without unprocessed xacro, which are read when asked for."""

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
