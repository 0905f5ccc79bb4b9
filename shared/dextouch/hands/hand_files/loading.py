"""Loading of a hand model file and its mapping file (docs/hands.md) into a `HandModel`.

Fixed joints are merged into the next hinge's frame or the tip. The resulting hand shows common
mistakes: millimetres, the thumb on the wrong side, fingers that bend backwards.
"""

import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from jaxtyping import Float64
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from dextouch.data_folder import read_bounded
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel, first_problem
from dextouch.geometry import apply, invert, transform
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from dextouch.hands.hand_files.models import (
    MAX_NUMBER,
    Element,
    Joint,
    MjcfModel,
    UrdfModel,
    read_elements,
    vector3,
)
from dextouch.hands.robot_hand import FingerTable, HandModel, JointRow
from dextouch.hands.skeleton import CHAINS

MAX_BYTES: Final = 64 * 2**10  # chosen: for a file that people write
Name = Annotated[str, Field(min_length=1)]
ModelFile = UrdfModel | MjcfModel
# Plausible lengths from knuckle to tip and from wrist to first hinge; detects millimetres.
FINGER_LENGTH_M: Final = (0.01, 0.5)
MAX_PALM_M: Final = 1.0
MAX_ANGLE_RAD: Final = 2 * np.pi
# Tolerance of the right angle between the two wrist directions, as a cosine.
RIGHT_ANGLE: Final = 1e-3
# Fingers at mid-range bend towards the palm; bending backwards by this share of their length cannot
# be explained by asymmetric limits.
MAX_BACKWARD: Final = 0.1


def _three_numbers(values: object) -> object:
    if (
        not isinstance(values, list)
        or len(values) != 3
        or not all(type(x) in (int, float) and abs(x) <= MAX_NUMBER for x in values)
    ):
        raise ValueError(
            f"got {values!r:.80}, expected three finite numbers of at most {MAX_NUMBER:g}"
        )
    return values


Vector = Annotated[tuple[float, float, float], BeforeValidator(_three_numbers)]


class _Table(FrozenModel):
    @model_validator(mode="before")
    @classmethod
    def _has_known_keys(cls, values: object) -> object:
        if not isinstance(values, dict):
            raise ValueError(f"got {values!r:.80}, expected a table")  # noqa: TRY004 - pydantic's
        # Before all else: an unknown key often explains why another is missing.
        for key in values:
            if key not in cls.model_fields:
                valid = ", ".join(sorted(cls.model_fields))
                raise ValueError(f"unknown key {key!r}; valid: {valid}")
        return values


class _ModelPart(_Table):
    """A table that names one part of the model: a link (of MJCF: a body) or a site."""

    link: Name | None = None
    body: Name | None = None

    @model_validator(mode="after")
    def _names_one_part(self) -> "_ModelPart":
        parts = [part for part in ("link", "body", "site") if part in type(self).model_fields]
        named = [part for part in parts if part in self.model_fields_set]
        if len(named) != 1:
            raise ValueError(
                f"got {' and '.join(named) or 'none'}, expected one of {', '.join(parts)}"
            )
        return self

    @property
    def link_name(self) -> str:
        """The link or body; empty where a site is named."""
        return self.link or self.body or ""


class TipMapping(_ModelPart):
    """Fingertip: a link (body) or a site, and an offset in its frame."""

    site: Name | None = None
    offset_m: Vector = (0.0, 0.0, 0.0)


class FingerMapping(_Table):
    """A finger: its chain of the tracked skeleton, joints from the wrist outwards, its tip."""

    chain: Name
    joints: tuple[str, ...]
    knuckle: Name
    pip: Name
    dip: Name
    tip: TipMapping


class WristMapping(_ModelPart):
    """The wrist's link, and our wrist axes in its frame."""

    fingers_along: Vector
    thumb_side: Vector
    origin_m: Vector = (0.0, 0.0, 0.0)


class HandMapping(_Table):
    """A hand: side, wrist and fingers."""

    side: Name
    wrist: WristMapping
    fingers: tuple[FingerMapping, ...]


def read_mapping(path: Path) -> HandMapping:
    """Read the mapping of one hand, of at most 64 KiB."""
    try:
        text = read_bounded(path, MAX_BYTES).decode("utf-8-sig")
        return HandMapping.model_validate(tomllib.loads(text))
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path.name}: got invalid UTF-8: {error}") from error
    # Deeply nested brackets hit the parser's recursion limit.
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InvalidInputError(f"{path.name}: got invalid TOML: {error}") from error
    except ValidationError as error:
        raise InvalidInputError(f"{path.name} {first_problem(error)}") from error


def load_hand(model_path: Path | str, mapping_path: Path | str) -> HandModel:
    """Load a hand from a URDF or MJCF file, without meshes, and a mapping file (docs/hands.md).

    Returns:
        The hand with joints in the mapping's order, the model's joint angles, and our wrist frame:
        fingers along -z, thumb side +x.

    Raises:
        NotFoundError, StorageError: a missing or unreadable file.
        LimitExceededError: a file above the size limit.
        UnknownNameError: a name that is not in the model; the valid ones are listed.
        InvalidInputError: any other invalid content; the message names file, element, found and
            expected value.
    """
    root = read_elements(Path(model_path))
    mapping, where = read_mapping(Path(mapping_path)), Path(mapping_path).name
    model, wrist = _model(root), mapping.wrist.link_name
    if wrist not in model.parents:
        raise UnknownNameError(f"link in {where} [wrist]:", wrist, list(model.parents))
    bases = _fixed_links(model, wrist, invert(_wrist_axes(mapping.wrist, f"{where} [wrist]")))
    tables = [
        _finger_table(model, finger, bases, f"{where} [[fingers]] {finger.chain!r}")
        for finger in mapping.fingers
    ]
    name = root.attributes.get("model") or root.attributes.get("name") or model.source
    hand = HandModel(mapping.side, tables, name=name)
    for table in tables:
        _check_units(table, f"{where}, finger {table.chain!r}")
    _check_mapping(hand, where)
    return hand


def _model(root: Element) -> ModelFile:
    if root.tag == "robot":
        return UrdfModel(root)
    if root.tag == "mujoco":
        return MjcfModel(root)
    raise root.refusal("expected <robot> (URDF) or <mujoco> (MJCF) as the outermost element")


def _wrist_axes(wrist: WristMapping, where: str) -> Float64[np.ndarray, "4 4"]:
    """T_wrist_ours: our wrist frame in the frame of the model's wrist link."""
    along, across = np.array(wrist.fingers_along), np.array(wrist.thumb_side)
    lengths = np.linalg.norm([along, across], axis=1)
    if lengths.min() < 1e-6:
        raise InvalidInputError(f"{where}: got a direction of zeros, expected two directions")
    z, x = -along / lengths[0], across / lengths[1]
    if abs(z @ x) > RIGHT_ANGLE:
        raise InvalidInputError(
            f"{where}: got fingers_along {along.tolist()} and thumb_side {across.tolist()} at "
            f"{np.rad2deg(np.arccos(np.clip(-z @ x, -1, 1))):.2f}°, expected 90°"
        )
    y = np.cross(z, x)
    y /= np.linalg.norm(y)
    return transform(np.stack([np.cross(y, z), y, z], axis=-1), np.array(wrist.origin_m))


def _fixed_links(
    model: ModelFile, wrist: str, T_ours_wrist: Float64[np.ndarray, "4 4"]
) -> dict[str, np.ndarray]:
    """T_ours_link [4, 4] of the wrist link and of all ancestors rigidly attached to it."""
    # Some models attach the wrist to the palm as a fingertip; fingers start at a common ancestor.
    T_ours_link = T_ours_wrist
    links: dict[str, np.ndarray] = {}
    link: str | None = wrist
    while link is not None and link not in links:
        links[link] = T_ours_link
        T_parent_link, joints = model.link(link)
        if joints:
            break
        T_ours_link = T_ours_link @ invert(T_parent_link)
        link = model.parents[link]
    return links


def _finger_table(
    model: ModelFile, finger: FingerMapping, bases: dict[str, np.ndarray], where: str
) -> FingerTable:
    """The table of one finger, which begins at one of `bases`, links fixed in our wrist frame."""
    tip = finger.tip
    if tip.site is not None:
        link, T_link_tip = model.site(tip.site, f"{where} tip")
    elif tip.link_name in model.parents:
        link, T_link_tip = tip.link_name, np.eye(4)
    else:
        raise UnknownNameError(f"link in {where} tip:", tip.link_name, list(model.parents))
    base, links = _links_between(model, bases, link, where)
    rows: list[JointRow] = []
    T_frame_link = bases[base]
    for step in [model.link(name) for name in links]:
        T_frame_link = T_frame_link @ step.T_parent_link
        for joint in step.joints:
            row, T_frame_link = _hinge(joint, T_frame_link, where)
            rows.append(row)
    names = [row.name for row in rows]
    if names != list(finger.joints):
        raise InvalidInputError(
            f"{where}: got joints {list(finger.joints)}, but between wrist and tip {model.source} "
            f"has {names}; list exactly those, from the wrist outwards"
        )
    for what in ("knuckle", "pip", "dip"):
        if getattr(finger, what) not in names:
            raise UnknownNameError(f"{what} of {where}", getattr(finger, what), names)
    points = (names.index(finger.knuckle), names.index(finger.pip), names.index(finger.dip))
    tip_m = apply(T_frame_link @ T_link_tip, np.array([tip.offset_m]))[0]
    return FingerTable(finger.chain, tuple(rows), vector3(tip_m), points)


def _links_between(
    model: ModelFile, bases: dict[str, np.ndarray], tip: str, where: str
) -> tuple[str, list[str]]:
    links: list[str] = []
    link = tip
    while link not in bases:
        if link in links:
            raise InvalidInputError(f"{where}: the links of {model.source} form a ring at {link!r}")
        links.append(link)
        parent = model.parents[link]
        if parent is None:
            raise InvalidInputError(
                f"{where}: the tip's link {tip!r} does not hang on the wrist link "
                f"{next(iter(bases))!r} in {model.source}; it hangs on {link!r}"
            )
        link = parent
    return link, links[::-1]


def _hinge(joint: Joint, T_frame_link: np.ndarray, where: str) -> tuple[JointRow, np.ndarray]:
    """A hinge's row, and T_hinge_link, the link's pose in the hinge's rotated frame."""
    if joint.refusal is not None:
        raise InvalidInputError(
            f"{joint.where}: {joint.refusal}; fingers are chains of hinges that move on their "
            f"own ({where}); make it fixed in the model, or leave the finger out"
        )
    if joint.limits_rad is None:
        raise InvalidInputError(
            f"{joint.where}: got no limits, expected a lowest and a highest angle; write them "
            "into the model"
        )
    anchor = np.array(joint.anchor_m)
    # At the joint's zero angle, which may differ from the angle of the file's reference pose.
    R_undrawn = rotation_from_vector(-joint.zero_rad * np.array(joint.axis))
    T_frame_hinge = T_frame_link @ transform(R_undrawn, anchor)
    w, x, y, z = quaternion_from_rotation(T_frame_hinge[:3, :3]).tolist()
    position_m = vector3(T_frame_hinge[:3, 3])
    row = JointRow(joint.name, position_m, (w, x, y, z), joint.axis, joint.limits_rad)
    return row, transform(np.eye(3), -anchor)


def _length_m(finger: FingerTable) -> float:
    """Length from knuckle to tip along the bones, independent of joint angles."""
    beyond = [row.position_m for row in finger.joints[finger.points[0] + 1 :]]
    return float(np.linalg.norm([*beyond, finger.tip_m], axis=-1).sum())


def _check_units(finger: FingerTable, where: str) -> None:
    length_m, palm_m = _length_m(finger), float(np.linalg.norm(finger.joints[0].position_m))
    shortest, longest = FINGER_LENGTH_M
    if not shortest <= length_m <= longest or palm_m > MAX_PALM_M:
        raise InvalidInputError(
            f"{where}: got {length_m:.4g} m from knuckle to tip and {palm_m:.4g} m from the wrist "
            f"to its first joint, expected {shortest} … {longest} m and at most {MAX_PALM_M} m; "
            "are the model's lengths metres, and tip, knuckle and wrist the right ones?"
        )
    for row in finger.joints:
        if max(map(abs, row.limits_rad)) > MAX_ANGLE_RAD:
            raise InvalidInputError(
                f"{where}, joint {row.name!r}: got limits {row.limits_rad} rad, expected less than "
                "a whole turn; are they degrees?"
            )


def _check_mapping(hand: HandModel, where: str) -> None:
    """Check that knuckles fall from the thumb's side, and that fingers bend to the palm."""
    # Knuckle, PIP, DIP and tip [4, 3] by chain, with all joints at mid-range.
    points_m = hand.chain_points_m(0.5 * (hand.lower_rad + hand.upper_rad)[None])[0]
    across_m = {f.chain: float(points_m[k, 0, 0]) for k, f in enumerate(hand.fingers)}
    falling_m = {chain: across_m[chain] for chain in CHAINS[1:] if chain in across_m}
    if any(near <= far for near, far in pairwise(falling_m.values())):
        listed = ", ".join(f"{chain} {1e3 * x_m:.1f} mm" for chain, x_m in falling_m.items())
        raise InvalidInputError(
            f"{where}: got knuckles along thumb_side at {listed}, expected them to fall "
            "from index to little; check thumb_side, fingers_along and the fingers' chains"
        )
    to_palm = 1.0 if hand.side == "right" else -1.0
    bends = [
        to_palm * (points_m[k, 3, 1] - points_m[k, 0, 1]) / _length_m(finger)
        for k, finger in enumerate(hand.fingers)
        if finger.chain != "thumb"
    ]
    if bends and float(np.mean(bends)) < -MAX_BACKWARD:
        raise InvalidInputError(
            f"{where}: fingers in the middle of their range bend to the back of a "
            f"{hand.side} hand (by {-float(np.mean(bends)):.2f} of their length); check side, "
            "thumb_side and fingers_along"
        )
