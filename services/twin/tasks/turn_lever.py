"""Turn Lever: push the lever of a fixed valve around with the palm and let go."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, moved
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks import task

# The valve's frame: on the table below the pivot; the closed lever points along x and turns
# clockwise, seen from above.
_LENGTH_M, _ARM_Z_M = 0.130, 0.018
_ARM_HALF_M: Final = (0.5 * _LENGTH_M, 0.011, 0.006)
_BASE_RADIUS_M, _BASE_HALF_M = 0.045, 0.005
_GRIP_RADIUS_M, _GRIP_TOP_M = 0.014, 0.080
_MARK_HALF_M: Final = (0.018, 0.003, 0.001)
_FRICTION_NM, _DAMPING_NM_S, _RANGE_RAD = 0.45, 0.03, 1.75
_TURNED_RAD: Final = np.pi / 3
_MOVED_RAD: Final = np.pi / 18
# Commanded end of the push; friction and the compliant wrist take a part of it.
_PUSH_RAD: Final = np.deg2rad(70.0)
_NUM_PUSHES: Final = 3
# The palm's centre beside the grip, below the base of the thumb; distances from the grip's surface.
_PALM_Z_M: Final = 0.074
_BESIDE_M, _AWAY_M = 0.018, 0.035
# Heading of the closed lever: it turns from the right towards the viewer, who sees palm and grip.
_CLOSED_RAD: Final = -0.3
_VALVE, _LEVER = range(2)


def _turned_rad(simulation: Simulation) -> float:
    """Angle of the lever from its closed position, clockwise."""
    T_world_valve, T_world_lever = transform_from_pose(simulation.object_poses())
    x_axis = T_world_valve[:3, :3].T @ T_world_lever[:3, 0]
    return float(np.arctan2(-x_axis[1], x_axis[0]))


class TurnLever:
    """Lower the right hand beside the lever's grip, push it around, let go, withdraw."""

    name = "turn_lever"
    instruction = "Push the lever around past the mark and let go."
    object_names = ("valve", "lever")
    milestones = ("touched", "moved", "turned", "released")

    def objects_mjcf(self) -> str:
        """A fixed base with a mark, and a lever with a grip; both collide with hands only."""
        alone = 'class="object" contype="0" conaffinity="1"'
        grip_half = 0.5 * (_GRIP_TOP_M - _ARM_Z_M)
        mark = _BASE_RADIUS_M + _MARK_HALF_M[0]
        along = np.array([np.cos(_TURNED_RAD), -np.sin(_TURNED_RAD), 0.0])
        return (
            f'<body name="valve" mocap="true"><geom name="valve_base" {alone} type="cylinder" '
            f'size="{numbers((_BASE_RADIUS_M, _BASE_HALF_M))}" pos="0 0 {_BASE_HALF_M!r}" '
            'rgba="0.20 0.24 0.34 1"/>'
            f'<geom name="valve_mark" {alone} type="box" size="{numbers(_MARK_HALF_M)}" '
            f'pos="{numbers(mark * along + [0.0, 0.0, _MARK_HALF_M[2]])}" '
            f'xyaxes="{numbers([*along, -along[1], along[0], 0.0])}" rgba="0.95 0.95 0.95 1"/>'
            f'<body name="lever" pos="0 0 {_ARM_Z_M!r}"><joint name="lever_hinge" type="hinge" '
            f'axis="0 0 -1" range="0 {_RANGE_RAD!r}" frictionloss="{_FRICTION_NM!r}" '
            f'damping="{_DAMPING_NM_S!r}" armature="0.0005"/>'
            f'<geom name="lever_arm" {alone} type="box" mass="0.08" '
            f'size="{numbers(_ARM_HALF_M)}" pos="{_ARM_HALF_M[0]!r} 0 0" rgba="0.92 0.78 0.16 1"/>'
            f'<geom name="lever_grip" {alone} type="cylinder" mass="0.06" '
            f'size="{numbers((_GRIP_RADIUS_M, grip_half))}" '
            f'pos="{numbers((_LENGTH_M, 0.0, grip_half))}" rgba="0.80 0.12 0.12 1"/></body></body>'
        )

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "2 7"]:
        """Valve behind the centre, ±3 cm and ±0.2 rad, lever closed."""
        x, y = generator.uniform(-0.03, 0.03, size=2)
        R = task.yawed(_CLOSED_RAD + float(generator.uniform(-0.2, 0.2)))
        pose = np.array([0.01 + x, 0.10 + y, 0.0, *quaternion_from_rotation(R)])
        poses = np.stack([pose, pose])
        poses[_LEVER, 2] = _ARM_Z_M
        return poses

    def script(
        self, poses: task.Poses, domain: Domain, draw: task.Draw, noise: task.Noise
    ) -> list[Waypoint]:
        """Move over the table beside the grip, down, push along the arc, back, up, withdraw."""
        start_m, away_m = draw.uniform(-0.02, 0.02, size=(2, 3))
        T_world_valve = transform_from_pose(poses[_VALVE])

        def hand(angle_rad: float, gap_m: float, up_m: float, error: WaypointNoise) -> HandPose:
            """Fingers towards the pivot, the palm behind the grip of a lever at an angle."""
            R_lever = T_world_valve[:3, :3] @ task.yawed(-angle_rad)
            behind = np.array([_LENGTH_M, _GRIP_RADIUS_M + gap_m, 0.0])
            palm_world = T_world_valve[:3, 3] + R_lever @ behind + error.offset_m
            palm_world[2] = _PALM_Z_M + up_m
            R = task.yawed(error.yaw_rad) @ R_lever @ task.yawed(0.5 * np.pi) @ task.THUMB_UP
            return task.with_palm("right", domain, R, palm_world)

        took, put = noise
        path = [
            (0.0, moved(hand(0.0, _AWAY_M + 0.05, 0.06, NO_NOISE), start_m)),
            (0.7, hand(0.0, _BESIDE_M, 0.08, took)),
            (1.1, hand(0.0, _BESIDE_M, 0.0, took)),
            (1.4, hand(0.0, 0.0, 0.0, took)),
        ]
        for index in range(1, _NUM_PUSHES + 1):
            share = index / _NUM_PUSHES
            error = WaypointNoise(
                (1 - share) * took.offset_m + share * put.offset_m,
                (1 - share) * took.yaw_rad + share * put.yaw_rad,
            )
            path.append((1.4 + 1.8 * share, hand(share * _PUSH_RAD, 0.0, 0.0, error)))
        path += [
            (3.4, hand(_PUSH_RAD, 0.0, 0.0, put)),
            (3.7, hand(_PUSH_RAD, _AWAY_M, 0.0, put)),
            (4.1, hand(_PUSH_RAD, _AWAY_M, 0.08, put)),
            (4.8, moved(hand(_PUSH_RAD, _AWAY_M + 0.08, 0.08, put), away_m)),
        ]
        return task.one_handed(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """Turned by 60° or more, at rest, untouched."""
        return _turned_rad(simulation) > _TURNED_RAD and task.is_left(simulation, _LEVER)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Lever touched by a hand; turned by 10°; turned by 60°; released and at rest."""
        turned_rad = _turned_rad(simulation)
        return (
            simulation.hand_touches(_LEVER),
            bool(turned_rad > _MOVED_RAD),
            bool(turned_rad > _TURNED_RAD),
            self.succeeded(simulation),
        )
