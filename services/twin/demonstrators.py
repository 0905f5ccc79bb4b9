"""Scripted demonstrators: smooth commands from waypoints of both hands, and other motions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import interpolate_linear, interpolate_poses, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import HandTrajectory
from dextouch.tactile.layout import SIDES
from services.twin.cameras import HEAD_HOME
from services.twin.hands import TwinHand, twin_hand
from services.twin.names import Domain, MotionKind
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
_END_S: Final = (NUM_GRID_STEPS - 1) / MODEL_RATE_HZ
_FIST: Final = np.tile(np.array([1.25, 0.0, 1.45, 1.0]), 5)
# Half the thickness of a finger or of the palm's edge, to keep hands above the table.
_HAND_RADIUS_M: Final = 0.010
_APART_M: Final = 0.07
# Below this difference from the first posture, the object is held by the wrists, not the fingers.
_SAME_POSTURE_RAD: Final = 0.1
_SLIP_S: Final = 0.2


@dataclass(frozen=True)
class HandPose:
    """Pose and joint angles of one hand."""

    T_world_wrist: Float64[np.ndarray, "4 4"]
    joints_rad: Float64[np.ndarray, "20"]


Hands = tuple[HandPose, HandPose]


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


NO_NOISE: Final = WaypointNoise(np.zeros(3), 0.0)


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
    """Commands of a take: smoothstep between waypoints at increasing times, else constant."""
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


@dataclass(frozen=True)
class Motion:
    """Motion of the hands from a step of the script (0 … 79) on.

    `retreat`: back to the start or up and away, with or without the held object.
    `push`: a sweep through an object's position with the current posture or a fist.
    `slip`: the script continues with a partially opened grasp.
    `wander`: both hands move smoothly between random positions near the objects.
    """

    kind: MotionKind
    from_step: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.from_step < NUM_GRID_STEPS - 1:
            raise InvalidInputError(
                f"twin: got a {self.kind} from step {self.from_step}, expected a step "
                f"0 … {NUM_GRID_STEPS - 2}"
            )


@dataclass(frozen=True)
class MotionScene:
    """The hands, and the initial object poses (x y z m, qw qx qy qz)."""

    domain: Domain
    object_poses: Float64[np.ndarray, "objects 7"]

    @property
    def hands(self) -> tuple[TwinHand, TwinHand]:
        """Left and right."""
        return twin_hand("left", self.domain), twin_hand("right", self.domain)


def with_motion(
    commands: HandTrajectory, motion: Motion, scene: MotionScene, generator: np.random.Generator
) -> HandTrajectory:
    """Replace a script's commands from the motion's step on; the head motion is kept."""
    if motion.kind == "slip":
        return _slipping(commands, motion.from_step, generator)
    draw = {"retreat": _retreat, "push": _push, "wander": _wander}[motion.kind]
    waypoints = draw(commands, motion.from_step, scene, generator)
    changed = vars(follow(waypoints, commands.Ts_world_camera_head))
    stop = motion.from_step + 1
    return HandTrajectory(
        **{
            name: np.concatenate([before[:stop], changed[name][stop:]])
            for name, before in vars(commands).items()
        }
    )


def _hands_at(commands: HandTrajectory, step: int) -> Hands:
    return (
        HandPose(commands.Ts_world_wrist_left[step], commands.joints_left_rad[step]),
        HandPose(commands.Ts_world_wrist_right[step], commands.joints_right_rad[step]),
    )


def _path(first: Hands, from_step: int, stops: list[tuple[float, Hands]]) -> list[Waypoint]:
    """Waypoints after a step; each stop has the time since the previous one in seconds."""
    waypoints = [Waypoint(from_step / MODEL_RATE_HZ, *first)]
    for duration_s, hands in stops:
        waypoints.append(Waypoint(waypoints[-1].time_s + duration_s, *hands))
    return waypoints


def _retreat(
    commands: HandTrajectory, from_step: int, scene: MotionScene, generator: np.random.Generator
) -> list[Waypoint]:
    del scene
    now, first = _hands_at(commands, from_step), _hands_at(commands, 0)
    goes_home, lets_go = generator.random(2) < 0.5
    away_m = generator.uniform([-0.08, -0.15, 0.10], [0.08, -0.03, 0.20])
    goal = first if goes_home else (moved(now[0], away_m), moved(now[1], away_m))
    postures = first if lets_go else now
    goal = (bent(goal[0], postures[0].joints_rad), bent(goal[1], postures[1].joints_rad))
    return _path(now, from_step, [(float(generator.uniform(0.8, 1.8)), goal)])


def _set_down(hand: TwinHand, pose: HandPose, middle_m: np.ndarray, lowest_m: float) -> HandPose:
    """Move a hand above a position with its lowest point at a given height."""
    fingers_m = hand.kinematics.chain_points_m(pose.joints_rad[None]).reshape(-1, 3)
    R = pose.T_world_wrist[:3, :3]
    points_m = np.concatenate([fingers_m, hand.palm_skin_m().reshape(-1, 3)]) @ R.T
    middle = 0.5 * (points_m.min(axis=0) + points_m.max(axis=0))
    z_m = lowest_m + _HAND_RADIUS_M - points_m[:, 2].min()
    place_m = np.array([middle_m[0] - middle[0], middle_m[1] - middle[1], z_m])
    return HandPose(transform(R, place_m), pose.joints_rad)


def _fist(hand: TwinHand) -> Float64[np.ndarray, "20"]:
    return np.clip(_FIST, hand.kinematics.lower_rad, hand.kinematics.upper_rad)


def _push(
    commands: HandTrajectory, from_step: int, scene: MotionScene, generator: np.random.Generator
) -> list[Waypoint]:
    now = _hands_at(commands, from_step)
    target_m = scene.object_poses[generator.integers(len(scene.object_poses)), :3]
    angle_rad = generator.uniform(0.0, 2 * np.pi)
    along = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    across = np.array([along[1], -along[0], 0.0])
    reach_m, lowest_m = generator.uniform([0.10, 0.004], [0.16, 0.035])
    middles_m = np.array([pose.T_world_wrist[:3, 3] for pose in now])
    nearest = int(np.linalg.norm(middles_m - target_m, axis=1).argmin())
    who = generator.random()
    pushes = [who < 0.2 or (side == nearest) == (who < 0.8) for side in range(len(SIDES))]
    is_fist = generator.random() < 0.4
    times_s = generator.uniform([0.7, 0.3, 0.5, 0.5, 0.3], [1.1, 0.5, 1.3, 1.3, 0.6])
    end_m = -reach_m if generator.random() < 0.4 else reach_m
    path = [(-reach_m, 0.12), (-reach_m, 0.0), (reach_m, 0.0), (end_m, 0.0), (end_m, 0.12)]
    stops: list[tuple[float, Hands]] = []
    for time_s, (along_m, up_m) in zip(times_s, path, strict=True):
        hands = list(now)
        for side, hand in enumerate(scene.hands):
            if pushes[side]:
                aside_m = (side - 0.5) * _APART_M * 2 * all(pushes)
                middle_m = target_m + along * along_m + across * aside_m
                pose = bent(now[side], _fist(hand)) if is_fist else now[side]
                hands[side] = moved(_set_down(hand, pose, middle_m, lowest_m), [0.0, 0.0, up_m])
        stops.append((float(time_s), (hands[0], hands[1])))
    return _path(now, from_step, stops)


def _wander(
    commands: HandTrajectory, from_step: int, scene: MotionScene, generator: np.random.Generator
) -> list[Waypoint]:
    now = _hands_at(commands, from_step)
    centre_m = scene.object_poses[:, :3].mean(axis=0)
    stops: list[tuple[float, Hands]] = []
    while from_step / MODEL_RATE_HZ + sum(time_s for time_s, _ in stops) < _END_S:
        hands = []
        for side, hand in enumerate(scene.hands):
            aside_m = np.array([(side - 0.5) * 2 * _APART_M, 0.0, 0.0])
            middle_m = centre_m + aside_m + generator.normal(scale=[0.07, 0.07, 0.0])
            turn = rotation_from_vector(np.array([0.0, 0.0, generator.normal(scale=0.3)]))
            share = generator.uniform(0.0, 0.7)
            joints = now[side].joints_rad + share * (_fist(hand) - now[side].joints_rad)
            pose = HandPose(transform(turn, np.zeros(3)) @ now[side].T_world_wrist, joints)
            hands.append(_set_down(hand, pose, middle_m, float(generator.uniform(0.008, 0.15))))
        stops.append((float(generator.uniform(0.7, 1.2)), (hands[0], hands[1])))
    return _path(now, from_step, stops)


def _slipping(
    commands: HandTrajectory, from_step: int, generator: np.random.Generator
) -> HandTrajectory:
    """Open fingers part of the way to the first posture; hands without a grip move apart."""
    opened, gap_m = generator.uniform([0.1, 0.005], [1.0, 0.045])
    since_s = np.arange(NUM_GRID_STEPS) / MODEL_RATE_HZ - from_step / MODEL_RATE_HZ
    share = np.clip(since_s / _SLIP_S, 0.0, 1.0)[:, None]
    joints = (commands.joints_left_rad, commands.joints_right_rad)
    grips = [np.abs(q[from_step] - q[0]).max() > _SAME_POSTURE_RAD for q in joints]
    left, right = commands.Ts_world_wrist_left.copy(), commands.Ts_world_wrist_right.copy()
    if not any(grips):
        direction = right[:, :3, 3] - left[:, :3, 3]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        left[:, :3, 3] -= gap_m * share * direction
        right[:, :3, 3] += gap_m * share * direction
    q_left, q_right = (q + opened * share * (q[0] - q) for q in joints)
    return HandTrajectory(left, right, q_left, q_right, commands.Ts_world_camera_head)
