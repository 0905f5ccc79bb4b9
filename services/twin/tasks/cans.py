"""Four tasks that start alike: hold up a full or an empty can, or move a can to the left or right.

Use them to test whether a policy or a world model heeds the instruction: the first observation of a
seed is the same in all four, so only the instruction tells how heavy the can is and where it goes.
"""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform_from_pose
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, moved
from services.twin.grasps import CylinderGrasp
from services.twin.mjcf import numbers
from services.twin.names import Domain
from services.twin.simulation import Simulation
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

Goal = Literal["up", "left", "right"]

CAN_RADIUS_M: Final = 0.025
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
CAN_GRASPS: Final[dict[Domain, CylinderGrasp]] = {
    "robot": CylinderGrasp(CAN_RADIUS_M, 0.035, -0.095, 0.45, 0.40, 0.0, 0.2),
    "human": CylinderGrasp(CAN_RADIUS_M, 0.039, -0.105, 0.45, 0.40, 0.0, 0.2),
}
_SQUEEZE_N: Final = 8.0
_OPEN_M: Final = 0.022
_LIFT_M: Final = 0.120
# Commanded depth below the table, so that the compliant wrist sets the can down firmly.
_PUSH_M: Final = 0.004
# Success: height of the raised can and its lean; distance from the mat's centre, so that the whole
# can stands on the mat.
_LIFTED_M, _RAISED_M, _MIN_UPRIGHT = 0.03, 0.08, 0.90
_ASIDE_M: Final = _MAT_HALF_M[0] - CAN_RADIUS_M
_OVER_M, _STANDING_M, _STANDING_UPRIGHT = 0.06, 0.006, 0.985
_MATS: Final[dict[Goal, int]] = {"left": 1, "right": 2}


def can_mjcf(half_length_m: float, mass_kg: float) -> str:
    """A can with a band near its top; its frame is in its middle, z up."""
    band_z = half_length_m - 2 * _BAND_HALF_M
    return (
        '<body name="can"><freejoint/><geom name="can_wall" class="object" type="cylinder" '
        f'mass="{mass_kg!r}" size="{numbers((CAN_RADIUS_M, half_length_m))}" '
        f'rgba="{_COLOURS["can"]}"/><geom name="can_band" class="object" type="cylinder" '
        f'contype="0" conaffinity="0" mass="0" pos="0 0 {band_z!r}" '
        f'size="{numbers((CAN_RADIUS_M + 0.0005, _BAND_HALF_M))}" rgba="{_COLOURS["band"]}"/>'
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
        return can_mjcf(_HALF_LENGTH_M, self.mass_kg) + mats

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
        grip = Grip(CAN_GRASPS[domain], domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)
        start_m, over_m = draw.uniform(-0.02, 0.02, size=(2, 3))

        def hand(can_m: np.ndarray, error: WaypointNoise) -> HandPose:
            """Open hand with its palm to the left, around a can that stands at a point."""
            point = np.array([can_m[0], can_m[1], _HALF_LENGTH_M + _GRIP_M]) + error.offset_m
            return grip.around(yawed(error.yaw_rad) @ THUMB_UP, point)

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
        return with_right_hand(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """Held up by a hand and at rest; or upright on its mat, at rest, untouched."""
        if simulation.object_speeds()[0] >= REST_SPEED:
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
        """Touched; lifted by 3 cm; then raised by 8 cm and held, or over the mat, on it, released.

        The whole can must stand on the mat.
        """
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
