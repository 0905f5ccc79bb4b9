"""Conversion of a model's links to the kinematic table of a finger in our wrist frame.

Fixed joints between hinges are merged into the frame of the next hinge or into the tip, so that
hinge angles are those of the model.
"""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry import apply, invert, transform
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from dextouch.hands.finger_table import FingerTable, JointRow, Quaternion
from dextouch.hands.hand_files.mapping import FingerMapping, TipMapping
from dextouch.hands.hand_files.mjcf import MjcfModel
from dextouch.hands.hand_files.model_file import Joint, Link, vector3
from dextouch.hands.hand_files.urdf import UrdfModel

# Links are read lazily: only those of fingers have to be valid.
ModelFile = UrdfModel | MjcfModel
_NO_TURN: Final = np.eye(3)


def fixed_links(
    model: ModelFile, wrist: str, T_ours_wrist: Float64[np.ndarray, "4 4"]
) -> dict[str, np.ndarray]:
    """T_ours_link [4, 4] of the wrist link and of all ancestors rigidly attached to it.

    Some models attach the wrist to the palm like another fingertip; fingers then start at a common
    ancestor.
    """
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


def finger_table(
    model: ModelFile, finger: FingerMapping, *, bases: dict[str, np.ndarray], where: str
) -> FingerTable:
    """Build the table of one finger.

    Args:
        model: of the hand.
        finger: its joints and tip in the model.
        bases: links fixed in our wrist frame, the wrist link first, with T_ours_link.
        where: prefix of error messages.

    Raises:
        InvalidInputError: the tip is not attached to the wrist; the joints between them are not
            those of the mapping, or are not hinges with limits.
        UnknownNameError: names that are not in the model or the finger.
    """
    T_link_tip, link = _tip(model, finger.tip, f"{where} tip")
    base, links = _links_between(model, bases, link, where)
    steps = [model.link(name) for name in links]
    _check_joints(steps, finger, model, where)
    rows: list[JointRow] = []
    T_frame_link = bases[base]
    for step in steps:
        T_frame_link = T_frame_link @ step.T_parent_link
        for joint in step.joints:
            row, T_frame_link = _hinge(joint, T_frame_link, where)
            rows.append(row)
    tip_m = apply(T_frame_link @ T_link_tip, np.array([finger.tip.offset_m]))[0]
    knuckle, pip, dip = (
        _index(finger, name, f"{what} of {where}")
        for what, name in (("knuckle", finger.knuckle), ("pip", finger.pip), ("dip", finger.dip))
    )
    return FingerTable(finger.chain, tuple(rows), vector3(tip_m), (knuckle, pip, dip))


def _tip(model: ModelFile, tip: TipMapping, where: str) -> tuple[np.ndarray, str]:
    if tip.site is not None:
        if tip.site not in model.sites:
            raise UnknownNameError(f"site in {where}:", tip.site, list(model.sites))
        link, T_link_site = model.site(tip.site)
        return T_link_site, link
    link = tip.link_name
    if link not in model.parents:
        raise UnknownNameError(f"link in {where}:", link, list(model.parents))
    return np.eye(4), link


def _links_between(
    model: ModelFile, bases: dict[str, np.ndarray], tip: str, where: str
) -> tuple[str, list[str]]:
    """The base link of a tip, and the links from there to the tip."""
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


def _check_joints(steps: list[Link], finger: FingerMapping, model: ModelFile, where: str) -> None:
    joints = [joint for step in steps for joint in step.joints]
    for joint in joints:
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
    names = tuple(joint.name for joint in joints)
    if names != finger.joints:
        raise InvalidInputError(
            f"{where}: got joints {list(finger.joints)}, but between wrist and tip {model.source} "
            f"has {list(names)}; list exactly those, from the wrist outwards"
        )


def _hinge(joint: Joint, T_frame_link: np.ndarray, where: str) -> tuple[JointRow, np.ndarray]:
    """A hinge's row, and T_hinge_link, the link's pose in the hinge's rotated frame."""
    if joint.limits_rad is None:
        raise InvalidInputError(f"{where}: joint {joint.name!r} has no limits")
    anchor = np.array(joint.anchor_m)
    # At the joint's zero angle, which may differ from the angle of the file's reference pose.
    R_undrawn = rotation_from_vector(-joint.zero_rad * np.array(joint.axis))
    T_frame_hinge = T_frame_link @ transform(R_undrawn, anchor)
    w, x, y, z = quaternion_from_rotation(T_frame_hinge[:3, :3]).tolist()
    q_wxyz: Quaternion = (w, x, y, z)
    position_m = vector3(T_frame_hinge[:3, 3])
    row = JointRow(joint.name, position_m, q_wxyz, joint.axis, joint.limits_rad)
    return row, transform(_NO_TURN, -anchor)


def _index(finger: FingerMapping, name: str, what: str) -> int:
    if name not in finger.joints:
        raise UnknownNameError(what, name, list(finger.joints))
    return finger.joints.index(name)
