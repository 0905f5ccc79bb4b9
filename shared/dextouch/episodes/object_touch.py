"""Poses of objects from touch, in takes that succeeded: where hands hold them and let them go.

An object that nothing measured and nobody clicked stands, until it is held, where the hand that
holds it is; then it moves with that hand, and it stays where it is let go. What it is put on
is where that happens. The file of objects says how an object stands and how it is held.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.episodes.object_poses import (
    ObjectTrack,
    listed_objects,
    standing_height_m,
    standing_rotation,
)
from dextouch.episodes.table import EpisodeGrid
from dextouch.geometry import apply, pose_from_transform, transform
from dextouch.geometry.rotations import rotation_from_vector, vector_from_rotation
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, poses_from_actions
from dextouch.hands.robot_hand import chain_points_of_both_m
from dextouch.schemas import SceneObject, SceneObjects, TouchedAt
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import SIDES

# Standard deviation of a position on each axis of the table: chosen, from errors of 3 to 10 mm over
# nine objects of four tasks of the twin (`python -m benchmarks objects`).
TOUCH_SD_M: Final = 7e-3
# Shorter contact is no hold: hands brush against things. Shorter gaps do not end one.
_LEAST_HOLD_S, _MOST_GAP_S = 0.5, 0.2
# From the first contact until the fingers are closed.
_CLOSING_S: Final = 0.13
# Two hands hold one object together for at least this share of the longer hold.
_TOGETHER: Final = 0.5
# Grips farther than this from the stated height hold something else, or one that does not stand.
_MOST_HEIGHT_M: Final = 0.1
# Thumb, fingers and palm take part in a grip if they touch for this share of it.
_PARTS: Final = (slice(0, 1), slice(1, 5), slice(5, 6))
_PART_SHARE: Final = 0.3
# Steeper directions than this sine from the thumb to the fingers give no heading.
_LEAST_LEVEL: Final = 0.3


@dataclass(frozen=True)
class _Hold:
    """Steps from closed fingers to the last contact, and poses of the hand at every step.

    `grip_m` and `closing_m` are in the wrist's frame: the middle of the grip, and the way from the
    thumb to the fingers, None if these do not both touch.
    """

    start: int
    end: int
    Ts_world_wrist: Float64[np.ndarray, "steps 4 4"]
    grip_m: Float64[np.ndarray, "3"]
    closing_m: Float64[np.ndarray, "3"] | None

    @property
    def lets_go(self) -> bool:
        return self.end + 1 < len(self.Ts_world_wrist)

    @cached_property
    def grips_m(self) -> Float64[np.ndarray, "steps 3"]:
        """The middle of the grip in the world at every step."""
        return apply(self.Ts_world_wrist, self.grip_m[None])[:, 0]


def touched_objects(grid: EpisodeGrid, objects: SceneObjects) -> ObjectTrack:
    """Poses of an episode's objects as touch gives them; unknown where it does not.

    An episode without success gives no poses, as hands may have missed; objects with `touch` get
    them.

    Raises UnknownNameError without the task in the file, InvalidInputError if the episode has other
    objects, or no outcome.
    """
    listed = listed_objects(grid.about, objects)
    track = ObjectTrack.unknown(len(grid), len(listed))
    if not grid.success or all(one.touch is None for one in listed):
        return track
    holds = _holds(grid)
    sources, sd_m = list(track.sources), track.sd_m
    for index, one in enumerate(listed):
        if one.touch is None or not (hands := _hands_of(holds, one.touch)):
            continue
        Ts = _poses(one, one.touch, hands, objects.table_z_m)
        if Ts is None:
            continue
        track.poses[:, index] = pose_from_transform(Ts)
        track.known[:, index] = True
        sources[index], sd_m[index] = "touch", TOUCH_SD_M
    return ObjectTrack(track.poses, track.known, tuple(sources), sd_m)


@dataclass(frozen=True)
class PadContacts:
    """Wrists of both hands at every step, and where their pads are and touch.

    Pads are those of thumb … little fingertip and palm, in the wrists' frames.
    """

    Ts_world_wrist: Float64[np.ndarray, "steps 2 4 4"]
    pads_m: Float64[np.ndarray, "steps 2 6 3"]
    touches: Bool[np.ndarray, "steps 2 6"]

    @classmethod
    def of(cls, grid: EpisodeGrid) -> "PadContacts":
        """Contacts of an episode, in the measured poses of its hands."""
        actions = grid.measured
        hands = poses_from_actions(actions, grid.anchor)
        joints_rad = np.stack([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1)
        chains_m = chain_points_of_both_m(joints_rad)
        tips_m, knuckles_m = chains_m[..., 3, :], chains_m[..., 0, :]
        palm_m = 0.5 * knuckles_m[:, :, 1:].mean(axis=2, keepdims=True)
        taxels_kpa, is_sampled = grid.touch()
        peaks_kpa = grid.tactile_layout.by_part(taxels_kpa, np.max)
        touches = np.greater_equal(peaks_kpa, CONTACT_THRESHOLD_KPA)
        # Where a glove has no sample, it touches as it did before.
        steps = np.arange(len(touches))[:, None]
        newest = np.maximum.accumulate(np.where(is_sampled, steps, 0), axis=0)
        return cls(
            np.stack([hands.Ts_world_wrist_left, hands.Ts_world_wrist_right], axis=1),
            np.concatenate([tips_m, palm_m], axis=2),
            np.take_along_axis(touches, newest[..., None], axis=0),
        )


def _holds(grid: EpisodeGrid) -> dict[str, _Hold]:
    """The hold of each hand that had a clear one."""
    contacts, rate_hz = PadContacts.of(grid), grid.about.model_rate_hz
    found: dict[str, _Hold] = {}
    for index, side in enumerate(SIDES):
        touches = contacts.touches[:, index]
        steps = _longest(np.logical_or.reduce(touches, axis=-1), rate_hz)
        if steps is not None:
            here = slice(*steps)
            grip = _grip(contacts.pads_m[here, index], touches[here])
            closed = steps[0] + round(_CLOSING_S * rate_hz)
            found[side] = _Hold(closed, steps[1] - 1, contacts.Ts_world_wrist[:, index], *grip)
    return found


def _longest(touches: Bool[np.ndarray, " steps"], rate_hz: float) -> tuple[int, int] | None:
    """First step of the only long contact, and the one after its last; None without a clear one.

    One that lasts from the first step on is none: what was held then did not stand.
    """
    edges = np.flatnonzero(np.diff(touches.astype(np.int8), prepend=0, append=0))
    if not len(edges):
        return None
    gaps = edges[2::2] - edges[1:-1:2]
    breaks = np.flatnonzero(gaps > _MOST_GAP_S * rate_hz)
    starts, ends = edges[::2][np.r_[0, breaks + 1]], edges[1::2][np.r_[breaks, len(gaps)]]
    lengths = ends - starts
    longest = int(lengths.argmax())
    second = max(np.delete(lengths, longest), default=0)
    if not second < _LEAST_HOLD_S * rate_hz <= lengths[longest] or starts[longest] == 0:
        return None
    return int(starts[longest]), int(ends[longest])


def _grip(
    pads_m: Float64[np.ndarray, "steps 6 3"], touches: Bool[np.ndarray, "steps 6"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"] | None]:
    """The middle of a grip in the wrist's frame, and the way from the thumb to the fingers."""
    middles: list[np.ndarray | None] = []
    for part in _PARTS:
        used = touches[:, part]
        takes_part = used.any(axis=1).mean() >= _PART_SHARE
        middles.append(pads_m[:, part][used].mean(axis=0) if takes_part else None)
    there = [middle for middle in middles if middle is not None]
    thumb, fingers, _ = middles
    closing_m = None if thumb is None or fingers is None else fingers - thumb
    middle_m = np.mean(there, axis=0) if there else pads_m[touches].mean(axis=0)
    return middle_m, closing_m


def _hands_of(holds: dict[str, _Hold], touch: TouchedAt) -> list[_Hold]:
    """The holds that count for an object: of its hand, or of both if they hold together."""
    sides = SIDES if touch.hand is None else (touch.hand,)
    hands = [holds[side] for side in sides if side in holds]
    if len(hands) < len(sides) or (touch.event == "release" and not all(h.lets_go for h in hands)):
        return []
    together = min(h.end for h in hands) - max(h.start for h in hands)
    return hands if together >= _TOGETHER * max(h.end - h.start for h in hands) else []


def _poses(
    one: SceneObject, touch: TouchedAt, hands: list[_Hold], table_z_m: float
) -> Float64[np.ndarray, "steps 4 4"] | None:
    """T_world_object at every step; None if the grip is too high, or gives no heading."""
    start, end = max(hold.start for hold in hands), min(hold.end for hold in hands)
    step = start if touch.event == "grasp" else end
    R = _standing(one, touch, hands, step)
    if R is None:
        return None
    point_m = np.array(one.box_m[:3] if touch.point_m is None else touch.point_m)
    origin_m = np.mean([hold.grips_m[step] for hold in hands], axis=0) - R @ point_m
    height_m = standing_height_m(one, table_z_m)
    if abs(origin_m[2] - height_m) > _MOST_HEIGHT_M:
        return None
    origin_m[2] = height_m
    T = transform(R, origin_m)
    num_steps = len(hands[0].Ts_world_wrist)
    if not one.is_carried:
        return np.tile(T, (num_steps, 1, 1))
    carried = _carried(hands, start)
    return carried[np.arange(num_steps).clip(start, end)] @ T


def _standing(
    one: SceneObject, touch: TouchedAt, hands: list[_Hold], step: int
) -> Float64[np.ndarray, "3 3"] | None:
    """R_world_object before it is held, from the direction in which the hands close."""
    direction = np.array([1.0, 0.0, 0.0])
    if touch.closing_deg is None:
        return standing_rotation(one, direction)
    if len(hands) > 1:
        closing = hands[1].grips_m[step] - hands[0].grips_m[step]
    elif hands[0].closing_m is not None:
        closing = hands[0].Ts_world_wrist[step, :3, :3] @ hands[0].closing_m
    else:
        return None
    level = np.linalg.norm(closing[:2])
    if level <= _LEAST_LEVEL * np.linalg.norm(closing):
        return None
    back = rotation_from_vector(np.array([0.0, 0.0, -np.deg2rad(touch.closing_deg)]))
    direction[:2] = closing[:2] / level
    return standing_rotation(one, back @ direction)


def _carried(hands: list[_Hold], start: int) -> Float64[np.ndarray, "steps 4 4"]:
    """How what the hands hold has moved in the world since a step."""
    first, last = (
        hold.Ts_world_wrist[:, :3, :3] @ hold.Ts_world_wrist[start, :3, :3].T
        for hold in (hands[0], hands[-1])
    )
    # Half of the way from one hand's turn to the other's.
    R = first @ rotation_from_vector(0.5 * vector_from_rotation(np.swapaxes(first, 1, 2) @ last))
    grips_m = np.mean([hold.grips_m for hold in hands], axis=0)
    shift = transform(np.eye(3), -grips_m[start])
    return transform(R, grips_m) @ shift
