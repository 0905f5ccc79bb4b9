"""Place Shoes: grasp one boot with each hand and set the pair down on a rack."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform, transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation
from dextouch.tactile.layout import Side
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, bent, moved
from services.twin.grasps import CylinderGrasp
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import SIGNS, THUMB_UP, Draw, Grip, Noise, Poses, is_left, yawed

# A boot's frame: origin below the centre of its sole, y towards the toe, z up.
_SOLE_HALF_M: Final = (0.030, 0.065, 0.008)
_SHAFT_RADIUS_M: Final = 0.025
_SHAFT_Y_M, _SHAFT_TOP_M = -0.032, 0.150
_TOE_HALF_M: Final = (0.024, 0.045, 0.010)
_TOE_Y_M: Final = 0.012
_RACK_HALF_M: Final = (0.145, 0.085, 0.010)
# Target positions of the soles' centres, right and left of the rack's centre.
_SLOT_X_M: Final = 0.075
_RACK_AT_M: Final = (0.0, 0.150)
_SHOES_AT_M: Final = (0.140, -0.085)
_COLOURS: Final = {
    "shoe_left": ("0.62 0.10 0.50 1", "0.36 0.05 0.30 1"),
    "shoe_right": ("0.06 0.50 0.42 1", "0.03 0.28 0.25 1"),
}
_RACK_COLOUR: Final = "0.90 0.82 0.20 1"
_GRASPS: Final[dict[Domain, CylinderGrasp]] = {
    "robot": CylinderGrasp(_SHAFT_RADIUS_M, 0.035, -0.095, 0.45, 0.40, 0.0, 0.2),
    "human": CylinderGrasp(_SHAFT_RADIUS_M, 0.039, -0.105, 0.45, 0.40, 0.0, 0.2),
}
# Grasp height on the shaft.
_GRASP_HEIGHT_M: Final = 0.098
_SQUEEZE_N: Final = 8.0
_OPEN_M: Final = 0.022
_PUSH_M: Final = 0.001
_LIFT_M: Final = 0.060
_MAX_OFFSET_M: Final = 0.025
_MAX_TURN_RAD: Final = 0.30
_MIN_UPRIGHT: Final = 0.985
_LIFTED_M, _MAX_HEIGHT_M = 0.030, 0.006
_LEFT, _RIGHT, _RACK = range(3)


def _yaw_rad(T: Float64[np.ndarray, "4 4"]) -> float:
    """Heading of an upright body: rotation of its y axis about the world's z."""
    return float(np.arctan2(-T[0, 1], T[1, 1]))


def _is_carried(simulation: Simulation, shoe_index: int) -> bool:
    height_m = simulation.object_poses()[shoe_index, 2]
    return bool(
        simulation.hand_touches(shoe_index)
        and height_m > _LIFTED_M
        and not simulation.touches_table(shoe_index)
        and not simulation.objects_touch(shoe_index, _RACK)
    )


def _in_place(simulation: Simulation) -> tuple[bool, bool]:
    """Whether the left and the right boot stand on the rack: within 25 mm, 0.30 rad and 10°."""
    *shoes, rack = transform_from_pose(simulation.object_poses())
    placed = []
    for index, (T_world_shoe, sign) in enumerate(zip(shoes, (-1.0, 1.0), strict=True)):
        T_rack_shoe = np.linalg.inv(rack) @ T_world_shoe
        x, y, z = T_rack_shoe[:3, 3]
        placed.append(
            bool(
                np.hypot(x - sign * _SLOT_X_M, y) < _MAX_OFFSET_M
                and abs(z - 2 * _RACK_HALF_M[2]) < _MAX_HEIGHT_M
                and abs(_yaw_rad(T_rack_shoe)) < _MAX_TURN_RAD
                and T_rack_shoe[2, 2] > _MIN_UPRIGHT
                and simulation.objects_touch(index, _RACK)
            )
        )
    return placed[0], placed[1]


class PlaceShoes:
    """Carry the left boot with the left hand and the right one with the right to the rack."""

    name = "place_shoes"
    instruction = "Pick up both shoes and place them side by side on the rack."
    object_names = ("shoe_left", "shoe_right", "rack")
    milestones = ("touched", "one_lifted", "both_lifted", "one_placed", "both_placed", "released")

    def objects_mjcf(self) -> str:
        """Two boots of sole, toe, shaft and opening, and a low, fixed rack."""
        rack = (
            '<body name="rack" mocap="true"><geom name="rack_board" class="object" type="box" '
            f'size="{numbers(_RACK_HALF_M)}" pos="0 0 {_RACK_HALF_M[2]!r}" '
            f'rgba="{_RACK_COLOUR}"/></body>'
        )
        return self._boot("shoe_left") + self._boot("shoe_right") + rack

    @staticmethod
    def _boot(name: str) -> str:
        light, dark = _COLOURS[name]
        sole_top = 2 * _SOLE_HALF_M[2]
        shaft_half = 0.5 * (_SHAFT_TOP_M - sole_top)
        shaft_z = sole_top + shaft_half
        toe = (0.0, _TOE_Y_M, sole_top + _TOE_HALF_M[2])
        return (
            f'<body name="{name}"><freejoint/>'
            f'<geom name="{name}_sole" class="object" type="box" mass="0.06" '
            f'size="{numbers(_SOLE_HALF_M)}" pos="0 0 {_SOLE_HALF_M[2]!r}" rgba="{dark}"/>'
            f'<geom name="{name}_toe" class="object" type="box" mass="0.02" '
            f'size="{numbers(_TOE_HALF_M)}" pos="{numbers(toe)}" rgba="{light}"/>'
            f'<geom name="{name}_shaft" class="object" type="cylinder" mass="0.08" '
            f'size="{numbers((_SHAFT_RADIUS_M, shaft_half))}" '
            f'pos="{numbers((0.0, _SHAFT_Y_M, shaft_z))}" rgba="{light}"/>'
            f'<geom name="{name}_opening" class="object" type="cylinder" mass="0" '
            f'size="{numbers((0.8 * _SHAFT_RADIUS_M, 0.001))}" contype="0" conaffinity="0" '
            f'pos="{numbers((0.0, _SHAFT_Y_M, _SHAFT_TOP_M))}" rgba="0.10 0.09 0.09 1"/></body>'
        )

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "3 7"]:
        """Boots left and right, ±3 cm and ±0.25 rad; the rack behind, ±2 cm and ±0.15 rad."""
        poses = np.zeros((3, 7))
        spread = np.array([[0.03, 0.03, 0.25]] * 2 + [[0.02, 0.02, 0.15]])
        x, y, yaw = (generator.uniform(-1.0, 1.0, size=(3, 3)) * spread).T
        poses[:, 0] = x + np.array([-_SHOES_AT_M[0], _SHOES_AT_M[0], _RACK_AT_M[0]])
        poses[:, 1] = y + np.array([_SHOES_AT_M[1], _SHOES_AT_M[1], _RACK_AT_M[1]])
        poses[:, 3:] = [quaternion_from_rotation(yawed(turn)) for turn in yaw]
        return poses

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Both hands: approach the shafts, enclose, close, lift, carry, lower, open, withdraw."""
        start_m = draw.uniform(-0.02, 0.02, size=(2, 3))
        over_m = draw.uniform(-0.015, 0.015, size=3)
        T_rack = transform_from_pose(poses[2])
        tracks = []
        for index, (side, sign) in enumerate(SIGNS):
            T_shoe = transform_from_pose(poses[index])
            slot = T_rack @ np.array([sign * _SLOT_X_M, 0.0, 2 * _RACK_HALF_M[2], 1.0])
            T_goal = transform(T_rack[:3, :3], slot[:3])
            tracks.append(
                self._track(side, domain, (T_shoe, T_goal), noise, (start_m[index], over_m))
            )
        return [
            Waypoint(time_s, left, right)
            for (time_s, left), (_, right) in zip(*tracks, strict=True)
        ]

    @staticmethod
    def _track(
        side: Side,
        domain: Domain,
        Ts_world_shoe: tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "4 4"]],
        noise: tuple[WaypointNoise, WaypointNoise],
        habits_m: tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]],
    ) -> list[tuple[float, HandPose]]:
        """Timed poses of one hand that carries a boot from the first pose to the second."""
        grasp, outwards = _GRASPS[domain], -1.0 if side == "left" else 1.0
        grip = Grip(grasp, domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)

        def around(T_world_shoe: np.ndarray, error: WaypointNoise) -> HandPose:
            R_shoe = yawed(_yaw_rad(T_world_shoe) + error.yaw_rad)
            shaft = R_shoe @ np.array([0.0, _SHAFT_Y_M, _GRASP_HEIGHT_M])
            point = T_world_shoe[:3, 3] + error.offset_m + shaft
            return grip.around(R_shoe @ THUMB_UP, point, side=side)

        start_m, over_m = habits_m
        beside = np.array([outwards * 0.11, -0.02, 0.03])
        reach, put = around(Ts_world_shoe[0], noise[0]), around(Ts_world_shoe[1], noise[1])
        before = moved(around(Ts_world_shoe[0], NO_NOISE), beside + start_m)
        took, down = grip.pressed(reach), grip.pressed(moved(put, [0.0, 0.0, -_PUSH_M]))
        return [
            (0.0, before),
            (0.9, reach),
            (1.25, took),
            (1.4, took),
            (1.9, moved(took, [0.0, 0.0, _LIFT_M])),
            (2.8, moved(down, over_m + np.array([0.0, 0.0, 0.8 * _LIFT_M]))),
            (3.4, down),
            (3.6, down),
            (4.0, bent(down, grip.open_rad)),
            (4.9, moved(bent(down, grip.open_rad), beside)),
        ]

    def succeeded(self, simulation: Simulation) -> bool:
        """Both boots upright at their positions on the rack, at rest, untouched."""
        return all(_in_place(simulation)) and is_left(simulation)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """A boot touched; one, both lifted or placed; one, both placed; released."""
        placed = _in_place(simulation)
        taken = [
            done or _is_carried(simulation, shoe)
            for done, shoe in zip(placed, (_LEFT, _RIGHT), strict=True)
        ]
        touched = simulation.hand_contacts()[:, [_LEFT, _RIGHT]].any()
        return (
            bool(touched),
            any(taken),
            all(taken),
            any(placed),
            all(placed),
            self.succeeded(simulation),
        )
