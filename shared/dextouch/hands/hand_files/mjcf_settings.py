"""MJCF compiler settings: units, default classes and orientation formats.

https://mujoco.readthedocs.io/en/stable/XMLreference.html: compiler, default, and the five ways to
write a frame's orientation.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from dextouch.errors import UnknownNameError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_quaternion, rotation_from_vector
from dextouch.hands.hand_files.elements import Element

MAIN_CLASS: Final = "main"
ORIENTATIONS: Final = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
_TINY: Final = 1e-9


class MjcfSettings:
    """Settings outside the bodies that affect the meaning of their attributes.

    Args:
        root: the `mujoco` element.

    Raises:
        InvalidInputError: a default class without a name or given twice, or invalid Euler axes.
        UnknownNameError: an invalid value of a compiler setting.
    """

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
        self, element: Element, name: str, inherited: dict[str, dict[str, str]]
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

    def with_defaults(self, element: Element, inherited_class: str) -> Element:
        """Apply the defaults of an element's class.

        Raises:
            UnknownNameError: an unknown class.
        """
        name = element.attributes.get("class", inherited_class)
        if name not in self._classes:
            raise UnknownNameError(f"class in {element}:", name, list(self._classes))
        defaults = self._classes[name].get(element.tag, {})
        return replace(element, attributes={**defaults, **element.attributes})

    def frame(self, element: Element) -> np.ndarray:
        """T_parent_element [4, 4] of a body, frame or site: `pos` and one kind of orientation.

        Raises:
            InvalidInputError: several orientations, or an invalid one.
        """
        position = element.numbers("pos", 3)
        return transform(self._rotation(element), np.array(position or (0.0, 0.0, 0.0)))

    def _rotation(self, element: Element) -> np.ndarray:
        kinds = [kind for kind in ORIENTATIONS if kind in element.attributes]
        if not kinds:
            return np.eye(3)
        if len(kinds) > 1:
            raise element.refusal(f"got {' and '.join(kinds)}, expected one orientation")
        kind = kinds[0]
        values = np.array(element.numbers(kind, ORIENTATIONS[kind]))
        R = self._euler(values) if kind == "euler" else _READERS[kind](values, self)
        if R is None:
            raise element.refusal(f"got {kind}={values.tolist()}, which is not a rotation")
        return R

    def _euler(self, values: np.ndarray) -> np.ndarray:
        R = np.eye(3)
        for axis, angle in zip(self._axes, values * self.radians_per_unit, strict=True):
            turn = rotation_from_vector(angle * np.eye(3)["xyz".index(axis.lower())])
            # Lower case means intrinsic, upper case extrinsic rotations.
            R = R @ turn if axis.islower() else turn @ R
        return R


def _unit(vector: np.ndarray) -> np.ndarray | None:
    length = np.linalg.norm(vector)
    return None if length < _TINY else vector / length


def _from_quaternion(values: np.ndarray, _: MjcfSettings) -> np.ndarray | None:
    return None if np.linalg.norm(values) < _TINY else rotation_from_quaternion(values)


def _from_axis_angle(values: np.ndarray, settings: MjcfSettings) -> np.ndarray | None:
    axis = _unit(values[:3])
    angle = values[3] * settings.radians_per_unit
    return None if axis is None else rotation_from_vector(axis * angle)


def _from_xy_axes(values: np.ndarray, _: MjcfSettings) -> np.ndarray | None:
    x = _unit(values[:3])
    if x is None:
        return None
    y = _unit(values[3:] - (values[3:] @ x) * x)
    return None if y is None else np.stack([x, y, np.cross(x, y)], axis=-1)


def _from_z_axis(values: np.ndarray, _: MjcfSettings) -> np.ndarray | None:
    """The smallest rotation of z to the given direction; a half turn is about x."""
    z = _unit(values)
    if z is None:
        return None
    across = _unit(np.cross([0.0, 0.0, 1.0], z))
    angle = np.arctan2(np.hypot(z[0], z[1]), z[2])
    return rotation_from_vector(angle * (np.array([1.0, 0, 0]) if across is None else across))


_READERS: Final = {
    "quat": _from_quaternion,
    "axisangle": _from_axis_angle,
    "xyaxes": _from_xy_axes,
    "zaxis": _from_z_axis,
}
