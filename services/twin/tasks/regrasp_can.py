"""Regrasp Can: lift a can out of a stand, set it down and grasp it again at its lower half."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform_from_pose
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, moved
from services.twin.mjcf import numbers
from services.twin.names import Domain
from services.twin.simulation import Simulation
from services.twin.tasks.cans import CAN_GRASPS, CAN_RADIUS_M, can_mjcf
from services.twin.tasks.task import (
    REST_SPEED,
    THUMB_UP,
    Draw,
    Grip,
    Noise,
    Poses,
    with_right_hand,
    yawed,
)

_HALF_LENGTH_M, _MASS_KG = 0.100, 0.16
# The stand: four walls around the can's lower part, so that only its upper half can be grasped.
_HOLE_HALF_M, _WALL_HALF_M, _WALL_HEIGHT_M = 0.034, 0.004, 0.080
_WALL_CONTACT: Final = 'friction="0.25 0.005 0.0001" priority="1"'
_WALL_COLOUR: Final = "0.16 0.20 0.34 1"
# Heights of both grasps above the table when the can stands.
_HIGH_M, _LOW_M = 0.165, 0.095
_SQUEEZE_N: Final = 8.0
_OPEN_M: Final = 0.022
_LIFT_M: Final = 0.120
_PUSH_M: Final = 0.003
# The can is set down on this side of the stand.
_ASIDE_M: Final = np.array([-0.15, -0.01, 0.0])
_OUT_M, _RAISED_M, _MIN_UPRIGHT = 0.010, 0.08, 0.90
_STANDING_M, _STANDING_UPRIGHT = 0.006, 0.985
_CAN, _STAND = range(2)


class RegraspCan:
    """Grasp the can at its upper half, set it down beside its stand, grasp it lower, lift it."""

    name = "regrasp_can"
    instruction = (
        "Lift the can out of the stand, put it down, grasp it again further down and hold it up."
    )
    object_names = ("can", "stand")
    milestones = ("touched", "lifted", "set_down", "regrasped", "held")

    def objects_mjcf(self) -> str:
        """A tall can, and a fixed, smooth stand of four walls."""
        middle_m, along_m = _HOLE_HALF_M + _WALL_HALF_M, _HOLE_HALF_M + 2 * _WALL_HALF_M
        up_m = 0.5 * _WALL_HEIGHT_M
        walls = "".join(
            f'<geom name="stand_wall{index}" class="object" type="box" {_WALL_CONTACT} '
            f'size="{numbers(size)}" pos="{numbers(place)}" rgba="{_WALL_COLOUR}"/>'
            for index, (size, place) in enumerate(
                [
                    ((_WALL_HALF_M, along_m, up_m), (middle_m, 0.0, up_m)),
                    ((_WALL_HALF_M, along_m, up_m), (-middle_m, 0.0, up_m)),
                    ((along_m, _WALL_HALF_M, up_m), (0.0, middle_m, up_m)),
                    ((along_m, _WALL_HALF_M, up_m), (0.0, -middle_m, up_m)),
                ]
            )
        )
        stand = f'<body name="stand" mocap="true">{walls}</body>'
        return can_mjcf(_HALF_LENGTH_M, _MASS_KG) + stand

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "2 7"]:
        """Stand with the can right of the middle, ±3 cm, turned by up to 0.2 rad."""
        poses = np.zeros((2, 7))
        poses[:, :2] = np.array([0.10, -0.02]) + generator.uniform(-0.03, 0.03, size=2)
        half_yaw = 0.5 * generator.uniform(-0.2, 0.2)
        poses[:, 3], poses[:, 6] = np.cos(half_yaw), np.sin(half_yaw)
        poses[_CAN, 2] = _HALF_LENGTH_M
        return poses

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Approach, close, lift out, set down, open, move down, close, lift."""
        grip = Grip(CAN_GRASPS[domain], domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)
        start_m, aside_m, high_m = draw.uniform(-0.02, 0.02, size=(3, 3))

        def hand(can_m: np.ndarray, height_m: float, error: WaypointNoise) -> HandPose:
            """Open hand with its palm to the left, around a can that stands at a point."""
            point = np.array([can_m[0], can_m[1], height_m]) + error.offset_m
            return grip.around(yawed(error.yaw_rad) @ THUMB_UP, point)

        stands_m = poses[_STAND, :3]
        spot_m = stands_m + _ASIDE_M + aside_m * [1.0, 1.0, 0.0]
        reach = hand(stands_m, _HIGH_M, noise[0])
        took = grip.pressed(reach)
        put = moved(reach, spot_m - stands_m - [0.0, 0.0, _PUSH_M])
        down = grip.pressed(put)
        again = hand(
            spot_m, _LOW_M, WaypointNoise(noise[0].offset_m + noise[1].offset_m, noise[1].yaw_rad)
        )
        retook = grip.pressed(again)
        raised = moved(retook, 0.5 * high_m + [0.0, 0.0, 0.11])
        path = [
            (
                0.0,
                moved(hand(stands_m, _HIGH_M, NO_NOISE), start_m + np.array([0.12, -0.05, 0.01])),
            ),
            (0.60, reach),
            (0.90, took),
            (1.00, took),
            (1.45, moved(took, [0.0, 0.0, _LIFT_M])),
            (1.95, moved(down, [0.0, 0.0, 0.5 * _LIFT_M])),
            (2.25, down),
            (2.35, down),
            (2.65, put),
            (3.00, again),
            (3.30, retook),
            (3.42, retook),
            (4.05, raised),
            (4.80, raised),
        ]
        return with_right_hand(path, domain)

    @staticmethod
    def _can_transform(simulation: Simulation) -> Float64[np.ndarray, "4 4"]:
        return transform_from_pose(simulation.object_poses()[_CAN])

    def _is_grasped_low(self, simulation: Simulation) -> bool:
        """Whether a hand touches the can, on average below its middle."""
        T_world_can = self._can_transform(simulation)
        heights_m = (simulation.hand_contacts_m(_CAN) - T_world_can[:3, 3]) @ T_world_can[:3, 2]
        return bool(heights_m.size and heights_m.mean() < 0.0)

    def _is_set_down(self, simulation: Simulation) -> bool:
        """Whether the can stands upright on the table, outside the stand."""
        T_world_can = self._can_transform(simulation)
        aside_m = np.abs(T_world_can[:2, 3] - simulation.object_poses()[_STAND, :2]).max()
        return bool(
            aside_m > _HOLE_HALF_M + 2 * _WALL_HALF_M + CAN_RADIUS_M
            and abs(T_world_can[2, 3] - _HALF_LENGTH_M) < _STANDING_M
            and T_world_can[2, 2] > _STANDING_UPRIGHT
        )

    def succeeded(self, simulation: Simulation) -> bool:
        """Held up by its lower half, outside the stand, upright and at rest."""
        T_world_can = self._can_transform(simulation)
        return bool(
            self._is_grasped_low(simulation)
            and T_world_can[2, 3] > _HALF_LENGTH_M + _RAISED_M
            and T_world_can[2, 2] > _MIN_UPRIGHT
            and not simulation.touches_table(_CAN)
            and not simulation.objects_touch(_CAN, _STAND)
            and simulation.object_speeds()[_CAN] < REST_SPEED
        )

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched; lifted out of the stand; standing beside it; grasped low there; held up."""
        touched = simulation.hand_touches(_CAN)
        foot_m = self._can_transform(simulation)[2, 3] - _HALF_LENGTH_M
        set_down = self._is_set_down(simulation)
        return (
            touched,
            bool(touched and foot_m > _WALL_HEIGHT_M + _OUT_M),
            set_down,
            set_down and self._is_grasped_low(simulation),
            self.succeeded(simulation),
        )
