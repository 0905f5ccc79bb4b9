"""Tasks with a can: four that differ by instruction alone at first, and one of two grasps."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform_from_pose
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, moved
from services.twin.grasps import CylinderGrasp
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import Draw, Grip, Noise, Poses, at_rest, one_handed

Goal = Literal["up", "left", "right"]

_RADIUS_M: Final = 0.025
_HALF_LENGTH_M, _BAND_HALF_M = 0.075, 0.012
# Grasp height above the can's centre, to keep the hand clear of the table.
_GRIP_M: Final = 0.025
_MAT_HALF_M: Final = (0.055, 0.055, 0.0005)
_COLOURS: Final = {
    "can": "0.80 0.10 0.14 1",
    "band": "0.95 0.92 0.86 1",
    "mat_left": "0.34 0.16 0.62 1",
    "mat_right": "0.10 0.52 0.30 1",
}
_GRASPS: Final[dict[Domain, CylinderGrasp]] = {
    "robot": CylinderGrasp(_RADIUS_M, 0.035, -0.095, 0.45, 0.40, 0.0, 0.2),
    "human": CylinderGrasp(_RADIUS_M, 0.039, -0.105, 0.45, 0.40, 0.0, 0.2),
}
_SQUEEZE_N: Final = 8.0  # chosen: holds the full can of 0.5 kg
_OPEN_M: Final = 0.022  # chosen: gap around the object before the grasp
_LIFT_M: Final = 0.120  # chosen: above _RAISED_M
# Commanded depth below the table, so that the compliant wrist sets the can down firmly.
_PUSH_M: Final = 0.004
# Success: height of the raised can and its lean; distance from the mat's centre, so that the whole
# can stands on the mat.
_LIFTED_M, _RAISED_M, _MIN_UPRIGHT = 0.03, 0.08, 0.90
_ASIDE_M: Final = _MAT_HALF_M[0] - _RADIUS_M
_OVER_M, _STANDING_M, _STANDING_UPRIGHT = 0.06, 0.006, 0.985
_MATS: Final[dict[Goal, int]] = {"left": 1, "right": 2}
# Regrasp Can: a taller can, in a stand of four walls around its lower part, so that only its upper
# half can be grasped.
_TALL_HALF_M, _TALL_KG, _TALL_PUSH_M = 0.100, 0.16, 0.003
_HOLE_HALF_M, _WALL_HALF_M, _WALL_HEIGHT_M = 0.034, 0.004, 0.080
_WALL_CONTACT: Final = 'friction="0.25 0.005 0.0001" priority="1"'
_WALL_COLOUR: Final = "0.16 0.20 0.34 1"
# Heights of both grasps above the table when the can stands, and where it is set down.
_HIGH_M, _LOW_M = 0.165, 0.095
_BESIDE_M: Final = np.array([-0.15, -0.01, 0.0])
_OUT_M: Final = 0.010
_CAN, _STAND = range(2)


def _can_mjcf(half_length_m: float, mass_kg: float) -> str:
    """A can with a band near its top; its frame is in its middle, z up."""
    band_z = half_length_m - 2 * _BAND_HALF_M
    return (
        '<body name="can"><freejoint/><geom name="can_wall" class="object" type="cylinder" '
        f'mass="{mass_kg!r}" size="{numbers((_RADIUS_M, half_length_m))}" '
        f'rgba="{_COLOURS["can"]}"/><geom name="can_band" class="object" type="cylinder" '
        f'contype="0" conaffinity="0" mass="0" pos="0 0 {band_z!r}" '
        f'size="{numbers((_RADIUS_M + 0.0005, _BAND_HALF_M))}" rgba="{_COLOURS["band"]}"/>'
        "</body>"
    )


@dataclass(frozen=True)
class CanTask:
    """Grasp the standing can from the side, lift it, and hold it up or set it down on a mat.

    Masses differ by a power of four, so that all numbers of the settling can are bit for bit alike.
    """

    name: str
    instruction: str
    goal: Goal
    mass_kg: float = 0.125
    object_names = ("can", "mat_left", "mat_right")

    @property
    def milestones(self) -> tuple[str, ...]:
        """See `Task`."""
        if self.goal == "up":
            return ("touched", "lifted", "raised", "held")
        return ("touched", "lifted", "over_mat", "placed", "released")

    def objects_mjcf(self) -> str:
        """A cylinder with a band, and two flat mats that hands and can do not collide with."""
        mats = "".join(
            f'<body name="{name}" mocap="true"><geom name="{name}_top" class="object" type="box" '
            f'contype="0" conaffinity="0" size="{numbers(_MAT_HALF_M)}" '
            f'pos="0 0 {_MAT_HALF_M[2]!r}" rgba="{_COLOURS[name]}"/></body>'
            for name in self.object_names[1:]
        )
        return _can_mjcf(_HALF_LENGTH_M, self.mass_kg) + mats

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "3 7"]:
        """Can in the middle, ±3 cm; mats behind it on the left and on the right, ±2 cm."""
        poses = np.zeros((3, 7))
        spread = np.array([[0.03], [0.02], [0.02]])
        middles = np.array([[0.02, -0.03], [-0.13, 0.10], [0.16, 0.12]])
        poses[:, :2] = middles + spread * generator.uniform(-1.0, 1.0, size=(3, 2))
        poses[0, 2], poses[:, 3] = _HALF_LENGTH_M, 1.0
        return poses

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Approach, close, lift as in every task of the four; then hold, or carry and set down."""
        grip = Grip(_GRASPS[domain], domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)
        start_m, over_m = draw.uniform(-0.02, 0.02, size=(2, 3))

        def hand(can_m: np.ndarray, error: WaypointNoise) -> HandPose:
            return grip.at(np.array([can_m[0], can_m[1], _HALF_LENGTH_M + _GRIP_M]), error)

        beside = moved(hand(poses[0], NO_NOISE), start_m + np.array([0.12, -0.07, 0.03]))
        reach = hand(poses[0], noise[0])
        took = grip.pressed(reach)
        raised = moved(took, [0.0, 0.0, _LIFT_M])
        path = [(0.0, beside), (0.8, reach), (1.15, took), (1.3, took), (1.9, raised)]
        # Equal times in all four tasks, so that `at_own_tempo` draws equal ones.
        times_s = (2.8, 3.4, 3.6, 4.0, 4.8)
        if self.goal == "up":
            high = moved(raised, 0.5 * over_m + [0.0, 0.0, 0.01])
            path += [(time_s, high) for time_s in times_s]
        else:
            left = hand(poses[_MATS[self.goal]], noise[1])
            put = moved(grip.pressed(left), [0.0, 0.0, -_PUSH_M])
            over = moved(put, 0.5 * over_m + [0.0, 0.0, 0.06])
            away = moved(left, [0.13, -0.02, 0.03])
            path += zip(times_s, (over, put, put, left, away), strict=True)
        return one_handed(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """Held up by a hand and at rest; or upright on its mat, at rest, untouched."""
        if not at_rest(simulation, 0):
            return False
        if self.goal == "up":
            return self._is_raised(simulation)
        return self._is_placed(simulation) and not simulation.hand_touches(0)

    @staticmethod
    def _is_raised(simulation: Simulation) -> bool:
        T_world_can = transform_from_pose(simulation.object_poses()[0])
        return bool(
            simulation.hand_touches(0)
            and not simulation.touches_table(0)
            and T_world_can[2, 3] > _HALF_LENGTH_M + _RAISED_M
            and T_world_can[2, 2] > _MIN_UPRIGHT
        )

    def _from_mat_m(self, simulation: Simulation) -> float:
        """Largest horizontal distance along the mat's sides between its and the can's centre."""
        poses = simulation.object_poses()
        return float(np.abs(poses[0, :2] - poses[_MATS[self.goal], :2]).max())

    def _is_placed(self, simulation: Simulation) -> bool:
        T_world_can = transform_from_pose(simulation.object_poses()[0])
        return bool(
            self._from_mat_m(simulation) < _ASIDE_M
            and abs(T_world_can[2, 3] - _HALF_LENGTH_M) < _STANDING_M
            and T_world_can[2, 2] > _STANDING_UPRIGHT
        )

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched; lifted by 3 cm; then raised by 8 cm and held, or over, on the mat, released."""
        touched = simulation.hand_touches(0)
        height_m = simulation.object_poses()[0, 2] - _HALF_LENGTH_M
        lifted = bool(touched and height_m > _LIFTED_M and not simulation.touches_table(0))
        if self.goal == "up":
            return touched, lifted, self._is_raised(simulation), self.succeeded(simulation)
        return (
            touched,
            lifted,
            lifted and self._from_mat_m(simulation) < _OVER_M,
            self._is_placed(simulation),
            self.succeeded(simulation),
        )


CAN_TASKS: Final = (
    CanTask("lift_full_can", "Pick up the full can and hold it up.", "up", 0.5),
    CanTask("lift_empty_can", "Pick up the empty can and hold it up.", "up", 0.125),
    CanTask("move_can_left", "Pick up the can and put it down on the left mat.", "left"),
    CanTask("move_can_right", "Pick up the can and put it down on the right mat.", "right"),
)


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
        return _can_mjcf(_TALL_HALF_M, _TALL_KG) + stand

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "2 7"]:
        """Stand with the can right of the middle, ±3 cm, turned by up to 0.2 rad."""
        poses = np.zeros((2, 7))
        poses[:, :2] = np.array([0.10, -0.02]) + generator.uniform(-0.03, 0.03, size=2)
        half_yaw = 0.5 * generator.uniform(-0.2, 0.2)
        poses[:, 3], poses[:, 6] = np.cos(half_yaw), np.sin(half_yaw)
        poses[_CAN, 2] = _TALL_HALF_M
        return poses

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Approach, close, lift out, set down, open, move down, close, lift."""
        grip = Grip(_GRASPS[domain], domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)
        start_m, aside_m, high_m = draw.uniform(-0.02, 0.02, size=(3, 3))

        def hand(can_m: np.ndarray, height_m: float, error: WaypointNoise) -> HandPose:
            return grip.at(np.array([can_m[0], can_m[1], height_m]), error)

        stands_m = poses[_STAND, :3]
        spot_m = stands_m + _BESIDE_M + aside_m * [1.0, 1.0, 0.0]
        reach = hand(stands_m, _HIGH_M, noise[0])
        took = grip.pressed(reach)
        put = moved(reach, spot_m - stands_m - [0.0, 0.0, _TALL_PUSH_M])
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
        return one_handed(path, domain)

    def _is_grasped_low(self, simulation: Simulation) -> bool:
        """Whether a hand touches the can, on average below its middle."""
        T_world_can = transform_from_pose(simulation.object_poses()[_CAN])
        heights_m = (simulation.hand_contacts_m(_CAN) - T_world_can[:3, 3]) @ T_world_can[:3, 2]
        return bool(heights_m.size and heights_m.mean() < 0.0)

    def _is_set_down(self, simulation: Simulation) -> bool:
        T_world_can = transform_from_pose(simulation.object_poses()[_CAN])
        aside_m = np.abs(T_world_can[:2, 3] - simulation.object_poses()[_STAND, :2]).max()
        return bool(
            aside_m > _HOLE_HALF_M + 2 * _WALL_HALF_M + _RADIUS_M
            and abs(T_world_can[2, 3] - _TALL_HALF_M) < _STANDING_M
            and T_world_can[2, 2] > _STANDING_UPRIGHT
        )

    def succeeded(self, simulation: Simulation) -> bool:
        """Held up by its lower half, outside the stand, upright and at rest."""
        T_world_can = transform_from_pose(simulation.object_poses()[_CAN])
        return bool(
            self._is_grasped_low(simulation)
            and T_world_can[2, 3] > _TALL_HALF_M + _RAISED_M
            and T_world_can[2, 2] > _MIN_UPRIGHT
            and not simulation.touches_table(_CAN)
            and not simulation.objects_touch(_CAN, _STAND)
            and at_rest(simulation, _CAN)
        )

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched; lifted out of the stand; standing beside it; grasped low there; held up."""
        touched = simulation.hand_touches(_CAN)
        foot_m = simulation.object_poses()[_CAN, 2] - _TALL_HALF_M
        set_down = self._is_set_down(simulation)
        return (
            touched,
            bool(touched and foot_m > _WALL_HEIGHT_M + _OUT_M),
            set_down,
            set_down and self._is_grasped_low(simulation),
            self.succeeded(simulation),
        )
