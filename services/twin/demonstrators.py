"""Scripted demonstrators: smooth commands on the model grid from waypoints of both hands."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import interpolate_linear, interpolate_poses, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import HandTrajectory
from services.twin.cameras import HEAD_HOME
from services.twin.simulation import MODEL_RATE_HZ

# 1 + 5 × 16 grid steps: a take of 5 1/3 s.
NUM_GRID_STEPS: Final = 81
# Head motion of a person watching their hands: centimetres and degrees.
_SWAY_M: Final = np.array([0.030, 0.025, 0.020])
_SWAY_RAD: Final = np.array([0.050, 0.050, 0.028])
# Spread of the head's home from take to take, where it varies.
_HOME_M: Final = 0.030
_HOME_RAD: Final = 0.040
# Range of the duration of each part of a take, relative to the nominal one.
_TEMPO: Final = (0.85, 1.15)
# An offset of a centimetre comes with a small rotation error.
YAW_NOISE_RAD_PER_M: Final = 5.0


@dataclass(frozen=True)
class HandPose:
    """Pose and joint angles of one hand."""

    T_world_wrist: Float64[np.ndarray, "4 4"]
    joints_rad: Float64[np.ndarray, "20"]


@dataclass(frozen=True)
class Waypoint:
    """Both hands at a time of the take."""

    time_s: float
    left: HandPose
    right: HandPose


@dataclass(frozen=True)
class WaypointNoise:
    """A demonstrator's error at one location: an offset on the table and a rotation about z."""

    offset_m: Float64[np.ndarray, "3"]
    yaw_rad: float

    @staticmethod
    def draw(generator: np.random.Generator, noise_m: float) -> "WaypointNoise":
        """Draw an error; the number of draws is fixed, so that noise levels share their seeds."""
        errors = generator.normal(size=3) * noise_m
        return WaypointNoise(
            np.array([errors[0], errors[1], 0.0]), float(errors[2] * YAW_NOISE_RAD_PER_M)
        )


def moved(hand: HandPose, offset_m: Sequence[float] | np.ndarray) -> HandPose:
    """Translate a hand in the world."""
    T = hand.T_world_wrist.copy()
    T[:3, 3] += np.asarray(offset_m)
    return HandPose(T, hand.joints_rad)


def bent(hand: HandPose, joints_rad: np.ndarray) -> HandPose:
    """Replace the joint angles of a hand."""
    return HandPose(hand.T_world_wrist, joints_rad)


def head_sway(generator: np.random.Generator) -> Float64[np.ndarray, "81 4 4"]:
    """T_world_camera_head at every grid step: a standing person's slow sway about home."""
    times_s = np.arange(NUM_GRID_STEPS) / MODEL_RATE_HZ
    rate_hz = generator.uniform(0.10, 0.40, size=6)
    phase = generator.uniform(0.0, 2 * np.pi, size=6)
    size = generator.uniform(0.2, 1.0, size=6)
    waves = size * np.sin(2 * np.pi * rate_hz * times_s[:, None] + phase)
    return HEAD_HOME @ transform(
        rotation_from_vector(waves[:, 3:] * _SWAY_RAD), waves[:, :3] * _SWAY_M
    )


def at_another_home(
    head: Float64[np.ndarray, "81 4 4"], generator: np.random.Generator
) -> Float64[np.ndarray, "81 4 4"]:
    """A head motion about another home: a person of another size, a camera mounted again."""
    turn = rotation_from_vector(generator.normal(scale=_HOME_RAD, size=3))
    moved_head = head @ transform(turn, np.zeros(3))
    moved_head[:, :3, 3] += generator.normal(scale=_HOME_M, size=3)
    return moved_head


def at_own_tempo(waypoints: Sequence[Waypoint], generator: np.random.Generator) -> list[Waypoint]:
    """Vary the timing of waypoints; start and end keep their time."""
    times = np.array([waypoint.time_s for waypoint in waypoints])
    parts = np.diff(times) * generator.uniform(*_TEMPO, size=len(times) - 1)
    parts *= (times[-1] - times[0]) / parts.sum()
    own = times[0] + np.concatenate([[0.0], np.cumsum(parts)])
    return [
        Waypoint(float(time_s), waypoint.left, waypoint.right)
        for time_s, waypoint in zip(own, waypoints, strict=True)
    ]


def follow(waypoints: Sequence[Waypoint], head: Float64[np.ndarray, "81 4 4"]) -> HandTrajectory:
    """Commands of a whole take: smoothstep between waypoints, constant before and after them.

    Raises:
        InvalidInputError: times that do not increase.
    """
    times = np.array([waypoint.time_s for waypoint in waypoints])
    if len(times) < 2 or (np.diff(times) <= 0).any():
        raise InvalidInputError(
            f"script: got waypoint times {times.tolist()} s, expected at least two, increasing"
        )
    at_s = np.clip(np.arange(NUM_GRID_STEPS) / MODEL_RATE_HZ, times[0], times[-1])
    left = np.clip(np.searchsorted(times, at_s, side="right") - 1, 0, len(times) - 2)
    ramp = (at_s - times[left]) / (times[left + 1] - times[left])
    weight = ramp * ramp * (3 - 2 * ramp)
    poses, joints = [], []
    for hands in ([w.left for w in waypoints], [w.right for w in waypoints]):
        poses.append(interpolate_poses(np.stack([h.T_world_wrist for h in hands]), left, weight))
        joints.append(interpolate_linear(np.stack([h.joints_rad for h in hands]), left, weight))
    return HandTrajectory(poses[0], poses[1], joints[0], joints[1], head)
