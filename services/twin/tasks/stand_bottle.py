"""Stand Bottle: grasp a lying bottle with one hand, turn it upright and set it down."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, bent, moved
from services.twin.grasps import CylinderGrasp
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import PALM_DOWN, Draw, Grip, Noise, Poses, is_left, one_handed, yawed

_RADIUS_M: Final = 0.025
_HALF_LENGTH_M: Final = 0.115
# A foot and a collar of this radius at its ends: it lies level, and fingers fit under it.
_FOOT_RADIUS_M, _FOOT_HALF_M = 0.034, 0.008
_CAP_RADIUS_M, _CAP_HALF_M = 0.014, 0.014
# Position of the bottle's centre in the hand, along its own axis.
_ALONG_M: Final = 0.010
_GRASPS: Final[dict[Domain, CylinderGrasp]] = {
    "robot": CylinderGrasp(_RADIUS_M, 0.035, -0.095, 0.45, 0.40, 0.050, _FOOT_RADIUS_M),
    "human": CylinderGrasp(_RADIUS_M, 0.039, -0.105, 0.45, 0.40, 0.050, _FOOT_RADIUS_M),
}
_SQUEEZE_N: Final = 10.0  # chosen: holds the bottle while it turns
_OPEN_M: Final = 0.020  # chosen: gap around the object before the grasp
# Commanded depth below the table, so that the compliant wrist sets the bottle down firmly.
_PUSH_M: Final = 0.001
# Pose of the bottle in the closed hand, where thumb and fingers rotate it: axis (towards the cap)
# and centre in the grasp frame, determined by closing the hand once.
_HELD_AXES: Final[dict[Domain, tuple[float, float, float]]] = {
    "robot": (0.889, -0.130, -0.440),
    "human": (0.967, -0.028, -0.250),
}
_HELD_MIDDLES_M: Final[dict[Domain, tuple[float, float, float]]] = {
    "robot": (0.0088, -0.0017, 0.0015),
    "human": (0.0127, -0.0010, -0.0010),
}
_RELEASE_S: Final = 0.4  # chosen: fingers open slowly
_LIFTED_M: Final = 0.03  # chosen: clear of the table's contact
# The bottle's z axis (cap) points to world -x at yaw 0.
_LYING: Final = rotation_from_vector(np.array([0.0, -0.5 * np.pi, 0.0]))
_ROLL_UP: Final = rotation_from_vector(np.array([0.0, 0.5 * np.pi, 0.0]))


def _turn_to_x(axis: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation from an axis to x."""
    unit = axis / np.linalg.norm(axis)
    turn = np.cross(unit, [1.0, 0.0, 0.0])
    sine = float(np.linalg.norm(turn))
    return rotation_from_vector(turn / max(sine, 1e-12) * np.arctan2(sine, unit[0]))


def _is_upright(pose: Float64[np.ndarray, "7"]) -> bool:
    return bool(transform_from_pose(pose)[2, 2] > 0.99)


def _is_at_standing_height(pose: Float64[np.ndarray, "7"]) -> bool:
    return bool(abs(pose[2] - _HALF_LENGTH_M) < 0.01)


class StandBottle:
    """Grasp the lying bottle with the right hand, turn it upright, set it down, let go."""

    name = "stand_bottle"
    instruction = "Pick up the bottle lying on the table and stand it upright."
    object_names = ("bottle",)
    milestones = ("touched", "lifted", "upright", "placed", "released")

    def objects_mjcf(self) -> str:
        """A cylinder with foot, collar and a narrower cap."""
        foot, foot_z = (_FOOT_RADIUS_M, _FOOT_HALF_M), _HALF_LENGTH_M - _FOOT_HALF_M
        cap_z = _HALF_LENGTH_M + _CAP_HALF_M
        return (
            '<body name="bottle"><freejoint/>'
            f'<geom name="bottle_body" class="object" type="cylinder" mass="0.14" '
            f'size="{numbers((_RADIUS_M, _HALF_LENGTH_M))}" rgba="0.20 0.62 0.32 1"/>'
            f'<geom name="bottle_foot" class="object" type="cylinder" mass="0.04" '
            f'size="{numbers(foot)}" pos="0 0 {-foot_z!r}" rgba="0.13 0.42 0.22 1"/>'
            f'<geom name="bottle_collar" class="object" type="cylinder" mass="0.02" '
            f'size="{numbers(foot)}" pos="0 0 {foot_z!r}" rgba="0.13 0.42 0.22 1"/>'
            f'<geom name="bottle_cap" class="object" type="cylinder" mass="0.02" '
            f'size="{numbers((_CAP_RADIUS_M, _CAP_HALF_M))}" pos="0 0 {cap_z!r}" '
            'rgba="0.95 0.92 0.30 1"/></body>'
        )

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "1 7"]:
        """Lying right of the centre, ±3 cm and ±0.25 rad."""
        x, y = generator.uniform(-0.03, 0.03, size=2)
        R = yawed(float(generator.uniform(-0.25, 0.25))) @ _LYING
        return np.array([[0.08 + x, 0.02 + y, _FOOT_RADIUS_M, *quaternion_from_rotation(R)]])

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Move over it, down, close, lift, roll, set down, open, withdraw."""
        grip = Grip(_GRASPS[domain], domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)
        T_world_bottle = transform_from_pose(poses[0])
        yaw = float(np.arctan2(-T_world_bottle[1, 2], -T_world_bottle[0, 2]))
        start_m, target_m = draw.uniform(-0.02, 0.02, size=(2, 3))

        def hand(error: WaypointNoise) -> HandPose:
            """Open hand around the bottle, its palm down."""
            R, point = (
                yawed(yaw + error.yaw_rad) @ PALM_DOWN,
                T_world_bottle[:3, 3] + error.offset_m,
            )
            return grip.around(R, point, held_m=(_ALONG_M, 0.0, 0.0))

        R_up = yawed(yaw + noise[1].yaw_rad) @ _ROLL_UP @ PALM_DOWN
        R_up = R_up @ _turn_to_x(np.array(_HELD_AXES[domain]))
        above = moved(hand(NO_NOISE), start_m + np.array([0.0, -0.02, 0.14]))
        reach = hand(noise[0])
        took = grip.pressed(reach)
        target = np.array([0.08, 0.04, _HALF_LENGTH_M]) + target_m * [1.0, 1.0, 0.0]
        there = target + noise[1].offset_m
        stand = grip.pressed(grip.around(R_up, there, held_m=_HELD_MIDDLES_M[domain]))
        away = moved(bent(stand, grip.open_rad), [0.13, -0.02, 0.02])
        path = [
            (0.0, above),
            (0.8, reach),
            (1.15, took),
            (1.3, took),
            (1.85, moved(took, [0.0, 0.0, 0.14])),
            (2.6, moved(stand, [0.0, 0.0, 0.05])),
            (3.1, moved(stand, [0.0, 0.0, _PUSH_M])),
            (3.3, moved(stand, [0.0, 0.0, _PUSH_M])),
            (3.3 + _RELEASE_S, moved(bent(stand, grip.open_rad), [0.0, 0.0, _PUSH_M])),
            (4.8, away),
        ]
        return one_handed(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """Upright within 8°, on the table within 1 cm, at rest, untouched."""
        pose = simulation.object_poses()[0]
        return bool(_is_upright(pose) and _is_at_standing_height(pose) and is_left(simulation, 0))

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched by a hand; lifted by 3 cm; upright; standing; released."""
        pose = simulation.object_poses()[0]
        touched = simulation.hand_touches(0)
        raised = bool(pose[2] > _FOOT_RADIUS_M + _LIFTED_M)
        upright = _is_upright(pose)
        return (
            touched,
            touched and raised and not simulation.touches_table(0),
            upright,
            upright and _is_at_standing_height(pose) and simulation.touches_table(0),
            self.succeeded(simulation),
        )
