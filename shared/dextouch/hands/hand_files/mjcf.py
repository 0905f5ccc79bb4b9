"""MJCF elements in, bodies with their joints out.

https://mujoco.readthedocs.io/en/stable/XMLreference.html. A body may have several joints, each
with its own anchor; `frame` elements move what stands in them.
"""

from typing import Final, NamedTuple

import numpy as np

from dextouch.geometry.transforms import apply
from dextouch.hands.finger_table import Vector3
from dextouch.hands.hand_files.elements import Element
from dextouch.hands.hand_files.mjcf_settings import MAIN_CLASS, MjcfSettings
from dextouch.hands.hand_files.model_file import Joint, Link

WORLD: Final = "world"
# What brings bodies from elsewhere: the file that is loaded must be the whole model.
_FOREIGN: Final = ("include", "attach", "replicate", "composite", "flexcomp")


class _Place(NamedTuple):
    """An element, the body it stands in, T_body_parent of the frames around it, and its class."""

    element: Element
    body: str
    T_body_parent: np.ndarray
    class_name: str


class MjcfModel:
    """The bodies of an MJCF file.

    Args:
        root: the `mujoco` element.

    Raises:
        InvalidInputError: bodies or sites with the same name, or parts that other files or
            MuJoCo's generators would bring in.
    """

    def __init__(self, root: Element) -> None:
        self.source = root.source.rpartition(" line ")[0]
        self._settings = MjcfSettings(root)
        self.parents: dict[str, str | None] = {WORLD: None}
        self._bodies: dict[str, _Place] = {}
        self._joints: dict[str, list[_Place]] = {WORLD: []}
        self._sites: dict[str, _Place] = {}
        self._coupled = {
            name
            for equality in root.each("equality")
            for joint in equality.each("joint")
            if joint.attributes.get("active", "true") == "true"
            for name in (joint.attributes.get("joint1"), joint.attributes.get("joint2"))
        }
        for child in root.each("include"):
            raise child.refusal(_flatten("include"))
        # A list of its own instead of recursion: files may be nested as deep as the reader allows.
        waiting = [_Place(child, WORLD, np.eye(4), MAIN_CLASS) for child in root.each("worldbody")]
        while waiting:
            self._read_children(waiting.pop(), waiting)

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of all sites that have one."""
        return tuple(self._sites)

    def _read_children(self, place: _Place, waiting: list[_Place]) -> None:
        class_name = place.element.attributes.get("childclass", place.class_name)
        for child in place.element.children:
            inner = _Place(child, place.body, place.T_body_parent, class_name)
            match child.tag:
                case "body":
                    waiting.append(self._read_body(inner))
                case "frame":
                    T_body_frame = place.T_body_parent @ self._settings.frame(child)
                    self._read_children(inner._replace(T_body_parent=T_body_frame), waiting)
                case "joint" | "freejoint":
                    self._joints[place.body].append(inner)
                case "site" if child.attributes.get("name"):
                    self._add(self._sites, child.text("name"), inner)
                case tag if tag in _FOREIGN:
                    raise child.refusal(_flatten(tag))

    def _read_body(self, place: _Place) -> _Place:
        # A body without a name cannot be meant by the mapping, but fingers may pass through it.
        name = place.element.attributes.get("name") or f"unnamed body at {place.element.source}"
        if name == WORLD:
            raise place.element.refusal(f"got the reserved name {WORLD!r}")
        # Two nameless bodies on one line are still two.
        while name in self.parents and not place.element.attributes.get("name"):
            name += "'"
        self._add(self._bodies, name, place)
        self.parents[name] = place.body
        self._joints[name] = []
        return _Place(place.element, name, np.eye(4), place.class_name)

    def _add(self, places: dict[str, _Place], name: str, place: _Place) -> None:
        if name in places:
            raise place.element.refusal(
                f"got this name twice, first in {places[name].element.source}; names must differ"
            )
        places[name] = place

    def link(self, name: str) -> Link:
        """A body with its joints.

        Raises:
            InvalidInputError: numbers that are none, orientations that are no rotation.
            UnknownNameError: a default class that the file does not have.
        """
        if name == WORLD:
            return Link(np.eye(4), ())
        place = self._bodies[name]
        T_parent_body = place.T_body_parent @ self._settings.frame(place.element)
        return Link(T_parent_body, tuple(self._joint(joint) for joint in self._joints[name]))

    def site(self, name: str) -> tuple[str, np.ndarray]:
        """The body of a site and T_body_site.

        Raises:
            InvalidInputError: a site drawn from a point to another, or broken numbers.
        """
        place = self._sites[name]
        element = self._settings.with_defaults(place.element, place.class_name)
        if "fromto" in element.attributes:
            raise element.refusal("got fromto, expected pos; name a body and an offset_m instead")
        return place.body, place.T_body_parent @ self._settings.frame(element)

    def _joint(self, place: _Place) -> Joint:
        element = self._settings.with_defaults(place.element, place.class_name)
        joint = Joint(element.attributes.get("name", ""), str(element))
        kind = element.attributes.get("type", "hinge")
        if element.tag == "freejoint" or kind != "hinge":
            kind = "free" if element.tag == "freejoint" else kind
            return joint._replace(refusal=f"its type is {kind!r}")
        if joint.name in self._coupled:
            return joint._replace(refusal="an equality constraint couples it to another joint")
        T = place.T_body_parent
        anchor = apply(T, np.array([element.numbers("pos", 3) or (0.0, 0.0, 0.0)]))[0]
        axis = T[:3, :3] @ np.array(element.numbers("axis", 3) or (0.0, 0.0, 1.0))
        length = float(np.linalg.norm(axis))
        if length < 1e-9:
            raise element.refusal(f"got axis {axis.tolist()}, expected a direction")
        (zero,) = element.numbers("ref", 1) or (0.0,)
        return joint._replace(
            anchor_m=_vector(anchor),
            axis=_vector(axis / length),
            limits_rad=self._limits(element),
            zero_rad=zero * self._settings.radians_per_unit,
        )

    def _limits(self, joint: Element) -> tuple[float, float] | None:
        values = joint.numbers("range", 2)
        limited = joint.choice("limited", "auto", "true", "false")
        if limited == "false" or values is None:
            return None
        if limited == "auto" and not self._settings.has_auto_limits:
            raise joint.refusal("got a range but autolimits is off; say limited='true' or 'false'")
        scale = self._settings.radians_per_unit
        return values[0] * scale, values[1] * scale


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z


def _flatten(tag: str) -> str:
    return (
        f"got <{tag}>, expected one whole file; load the model in MuJoCo and save it with "
        "mujoco.mj_saveLastXML"
    )
