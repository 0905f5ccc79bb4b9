"""Colour servo: a policy without learning that reaches for a colour and reacts to touch.

It knows the object colours of two tasks and needs five chunks of 16 steps.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from dextouch.clients import PolicyStart
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry import apply, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import actions
from dextouch.schemas import CHUNK_STEPS, Observation
from dextouch.streams import HEAD_CAMERA

# Pixels of the object are brighter than this, and their hue (share of each colour in their sum)
# differs by at most this from the object's.
_LEAST_BRIGHTNESS, _HUE_TOLERANCE, _LEAST_PIXELS = 60, 0.10, 4
# Pressure above which a taxel indicates a grasp.
_FELT_KPA: Final = 2.0
# Fingers that point forward by less than this share count as upright.
_LEAST_FORWARD: Final = 0.1
# Joint angles of the closed hand relative to the open one: thumb, index, middle, ring, little.
_CLOSING_RAD: Final = np.array(
    [[0.5, 0.1, 0.7, 0.4], [0.0, 0.0, 0.55, 0.4], [0.1, 0.0, 0.45, 0.25], [0.1, 0.0, 0.4, 0.2],
     [0.0, 0.0, 0.35, 0.2]]
).ravel()  # fmt: skip


@dataclass(frozen=True)
class Thing:
    """Object to reach for: its colour, the height of its centre above the table, and the grip.

    The grip is the point of the right hand that goes there, in the wrist frame.
    """

    colour: tuple[float, float, float]
    height_m: float
    grip_m: tuple[float, float, float]


HANDLE: Final = Thing((0.95, 0.85, 0.20), 0.058, (0.0, 0.074, -0.119))
BOTTLE: Final = Thing((0.20, 0.62, 0.32), 0.034, (0.009, 0.035, -0.099))


def thing_pixels(image: UInt8[np.ndarray, "h w 3"], thing: Thing) -> Bool[np.ndarray, "h w"]:
    """Mask of the pixels with the object's colour."""
    rgb = image.astype(np.float64)
    hue = rgb / np.maximum(rgb.sum(axis=-1, keepdims=True), 1.0)
    chromaticity = np.array(thing.colour) / sum(thing.colour)
    is_near = np.abs(hue - chromaticity).max(axis=-1) < _HUE_TOLERANCE
    return np.asarray(is_near & (rgb.max(axis=-1) > _LEAST_BRIGHTNESS))


def thing_place_m(
    image: UInt8[np.ndarray, "h w 3"],
    thing: Thing,
    T_world_camera: Float64[np.ndarray, "4 4"],
    K: Float64[np.ndarray, "3 3"],
) -> Float64[np.ndarray, "3"] | None:
    """World position of the centre of a colour, assumed at the object's height.

    None if fewer than four pixels have the colour, or the camera does not look down on them.
    """
    rows, columns = np.nonzero(thing_pixels(image, thing))
    if len(rows) < _LEAST_PIXELS:
        return None
    # Pixel (0, 0) covers 0 … 1.
    pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
    ray = T_world_camera[:3, :3] @ np.linalg.solve(K, pixel)
    if ray[2] >= 0:
        return None
    eye_m = T_world_camera[:3, 3]
    return np.asarray(eye_m + ray * (thing.height_m - eye_m[2]) / ray[2])


@dataclass(frozen=True)
class Key:
    """Target of the hand at a step of a chunk.

    The grip's offset from the object is given to the right, forward (the direction of the fingers
    at step 0) and up; the hand is turned by a rotation vector in those axes, and closed by a share.
    """

    step: int
    offset_m: tuple[float, float, float]
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    closed: float = 0.0


# Mostly the bar of the yellow handle is visible; fingers go down between bar and drawer.
_PULL: Final = (
    (Key(10, (0.0, 0.016, 0.045)), Key(16, (0.0, 0.016, 0.0))),
    (Key(4, (0.0, 0.016, -0.018)), Key(16, (0.0, -0.030, -0.018))),
    (Key(12, (0.0, -0.076, -0.018)), Key(16, (0.0, -0.076, -0.018))),
    (Key(4, (0.0, -0.062, -0.018)), Key(14, (0.0, -0.062, 0.060))),
    (Key(14, (0.13, -0.110, 0.090)),),
)
# Rotation that stands up a bottle lying in the closed hand; found empirically.
_UP: Final = (0.70, 1.29, 0.66)
_STAND: Final = (
    (Key(10, (0.0, 0.0, 0.02)), Key(14, (0.0, 0.0, 0.0))),
    (Key(6, (0.0, 0.0, 0.0), closed=1.0), Key(16, (0.0, 0.0, 0.12), closed=1.0)),
    (Key(14, (0.0, 0.02, 0.131), _UP, 1.0),),
    (
        Key(8, (0.0, 0.02, 0.081), _UP, 1.0),
        Key(9, (0.0, 0.02, 0.081), _UP, 1.0),
        Key(15, (0.0, 0.02, 0.081), _UP),
    ),
    (Key(2, (0.0, 0.02, 0.081), _UP), Key(16, (0.13, 0.0, 0.101), _UP)),
)
# Motion after a grasp without touch.
_GIVE_UP: Final = (Key(12, (0.0, -0.06, 0.14)),)
# Chunks that require touch at their beginning.
_NEEDS_TOUCH: Final = (2,)
_PLANS: Final = {"open_drawer": (HANDLE, _PULL), "stand_bottle": (BOTTLE, _STAND)}


class ColourServo:
    """Moves to a colour and reacts to touch; the left hand and the head stay still.

    `open_drawer`: behind the yellow handle, down, back, up. `stand_bottle`: over the green bottle,
    close, lift, turn, set down. If the colour is hidden, its last position is used. A hand without
    touch after hooking or closing goes up and stops.
    """

    uses_images = "last"
    tasks = tuple(_PLANS)

    def __init__(self) -> None:
        self._start: PolicyStart | None = None
        self._place_m: np.ndarray | None = None
        self._sent: Key | None = None
        self._open_rad = np.zeros(20)
        self._gave_up = False

    def reset(self, start: PolicyStart) -> None:
        """Start a new rollout; raises UnknownNameError for a task whose colours are not known."""
        if start.task not in _PLANS:
            raise UnknownNameError("task of the colour servo", start.task, list(_PLANS))
        self._start, self._place_m, self._sent, self._gave_up = start, None, None, False

    def act(self, observation: Observation) -> Float64[np.ndarray, "16 67"]:
        """The next 16 commanded actions, relative to the rollout's step 0.

        Raises InvalidInputError before `reset`, and UnknownNameError without a head camera.
        """
        if self._start is None:
            raise InvalidInputError("colour servo: act before reset; call reset with the start")
        if HEAD_CAMERA not in observation.images:
            raise UnknownNameError("camera", HEAD_CAMERA, list(observation.images))
        thing, plan = _PLANS[self._start.task]
        now = observation.action_reached[-1]
        chunk_index = (observation.first_step + len(observation) - 1) // CHUNK_STEPS
        if self._place_m is None:
            poses = actions.poses_from_actions(now[None], self._start.anchor)
            self._place_m = thing_place_m(
                observation.images[HEAD_CAMERA][-1],
                thing,
                poses.Ts_world_camera_head[0],
                self._start.K_head,
            )
            self._open_rad = now[actions.JOINTS_RIGHT].copy()
        feels = bool(observation.tactile_kpa[-1, 1].max() > _FELT_KPA)
        self._gave_up |= chunk_index in _NEEDS_TOUCH and not feels
        if self._place_m is None or chunk_index >= len(plan):
            return np.tile(now, (CHUNK_STEPS, 1))
        keys = _GIVE_UP if self._gave_up else plan[chunk_index]
        # Linear interpolation between keys, from the last action sent.
        anchor = self._start.anchor
        still = actions.poses_from_actions(np.tile(now, (CHUNK_STEPS, 1)), anchor)
        R_start = anchor.T_world_wrist_right[:3, :3]
        R_world_axes = _axes(R_start)
        grip_m = apply(still.Ts_world_wrist_right[0], np.array([thing.grip_m]))[0]
        begin = self._sent or Key(0, tuple(R_world_axes.T @ (grip_m - self._place_m)))
        self._sent = replace(keys[-1], step=0)
        way = _between((begin, *keys))
        turns = R_world_axes @ rotation_from_vector(way[:, 3:6]) @ R_world_axes.T
        Rs = turns @ R_start
        grips_m = self._place_m + way[:, :3] @ R_world_axes.T
        wrists = transform(Rs, grips_m - Rs @ np.array(thing.grip_m))
        joints_rad = self._open_rad + way[:, 6:] * _CLOSING_RAD
        return actions.actions_from_poses(
            actions.HandTrajectory(
                still.Ts_world_wrist_left,
                wrists,
                still.joints_left_rad,
                joints_rad,
                still.Ts_world_camera_head,
            ),
            anchor,
        )


def _axes(R_world_wrist: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """R_world_axes: right, forward as the fingers point (or along the world's y), and up."""
    forward = -R_world_wrist[:, 2] * [1.0, 1.0, 0.0]
    length = np.linalg.norm(forward)
    forward = forward / length if length > _LEAST_FORWARD else np.array([0.0, 1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(forward, up), forward, up], axis=1)


def _between(keys: tuple[Key, ...]) -> Float64[np.ndarray, "16 7"]:
    """Offset, rotation and closing at steps 1 … 16 of a chunk; the last key is held."""
    values = np.array([(*key.offset_m, *key.turn_rad, key.closed) for key in keys])
    steps = np.arange(1, CHUNK_STEPS + 1)
    at = [key.step for key in keys]
    return np.stack([np.interp(steps, at, column) for column in values.T], axis=1)
