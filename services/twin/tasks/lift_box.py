"""Lift Box: press a box between both palms, lift it and set it down on a platform."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import invert, transform, transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import SIGNS, THUMB_UP, Draw, Noise, Poses, is_left, with_palm, yawed

_HALF_M: Final = (0.075, 0.055, 0.031)
_MASS_KG: Final = 0.4
_LID_HALF_M: Final = (_HALF_M[0], _HALF_M[1], 0.008)
_PLATFORM_HALF_M: Final = (0.085, 0.065, 0.015)
_COLOURS: Final = {
    "box": "0.86 0.52 0.16 1",
    "lid": "0.20 0.26 0.62 1",
    "platform": "0.16 0.52 0.44 1",
}
# Height of the palms' centres above the box's: the palms press low, since the base of a human thumb
# protrudes above. Their distance from its sides, open and when commanded to squeeze.
_PALM_UP_M: Final = 0.022
_OPEN_M, _SQUEEZE_M = 0.032, -0.016
_LIFT_M: Final = 0.090
# Commanded depth below the platform, so that the compliant wrists set the box down firmly.
_PUSH_M: Final = 0.004
# Success: distance to the platform's centre, height, heading (cosine) and upright.
_ASIDE_M, _MAX_HEIGHT_M, _ALIGNED, _UPRIGHT = 0.022, 0.006, 0.94, 0.985
_LIFTED_M, _OVER_M = 0.03, 0.06
_TOP_M: Final = 2 * _PLATFORM_HALF_M[2] + _HALF_M[2]
_BOX, _PLATFORM = range(2)


def _from_goal(simulation: Simulation) -> Float64[np.ndarray, "4 4"]:
    """Pose of the box relative to its target pose on the platform."""
    T_world_box, T_world_platform = transform_from_pose(simulation.object_poses())
    T_world_goal = T_world_platform @ transform(np.eye(3), np.array([0.0, 0.0, _TOP_M]))
    return np.asarray(invert(T_world_goal) @ T_world_box)


class LiftBox:
    """Both palms press the box from its sides, lift it, carry it, set it down and let go."""

    name = "lift_box"
    instruction = "Lift the box between both palms and put it down on the platform."
    object_names = ("box", "platform")
    milestones = ("touched", "lifted", "over_platform", "placed", "released")

    def objects_mjcf(self) -> str:
        """A box with a lid of another colour, and a fixed platform."""
        lid_z = _HALF_M[2] - _LID_HALF_M[2]
        return (
            '<body name="box"><freejoint/>'
            f'<geom name="box_carton" class="object" type="box" mass="{_MASS_KG!r}" '
            f'size="{numbers(_HALF_M)}" rgba="{_COLOURS["box"]}"/>'
            '<geom name="box_lid" class="object" type="box" mass="0" contype="0" conaffinity="0" '
            f'size="{numbers(np.add(_LID_HALF_M, 0.0005))}" pos="0 0 {lid_z!r}" '
            f'rgba="{_COLOURS["lid"]}"/></body>'
            '<body name="platform" mocap="true"><geom name="platform_block" class="object" '
            f'type="box" size="{numbers(_PLATFORM_HALF_M)}" pos="0 0 {_PLATFORM_HALF_M[2]!r}" '
            f'rgba="{_COLOURS["platform"]}"/></body>'
        )

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "2 7"]:
        """Box on the left, ±3 cm; platform on the right behind, ±2 cm; each turned by ±0.2 rad."""
        poses = np.zeros((2, 7))
        spread = np.array([[0.03, 0.03, 0.2], [0.02, 0.02, 0.2]])
        x, y, yaw = (generator.uniform(-1.0, 1.0, size=(2, 3)) * spread).T
        poses[:, :2] = np.array([[-0.13, -0.05], [0.13, 0.08]]) + np.stack([x, y], axis=1)
        poses[_BOX, 2] = _HALF_M[2]
        poses[:, 3:] = [quaternion_from_rotation(yawed(turn)) for turn in yaw]
        return poses

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Lower beside the box, squeeze, lift, carry, set down, open, withdraw."""
        start_m, over_m = draw.uniform(-0.02, 0.02, size=(2, 3))
        T_world_box, T_world_goal = transform_from_pose(poses)
        T_world_goal = T_world_goal @ transform(np.eye(3), np.array([0.0, 0.0, _TOP_M]))

        def beside(
            T_world_x: np.ndarray, gap_m: float, up_m: float, error: WaypointNoise
        ) -> tuple[HandPose, HandPose]:
            """Palms at both sides of a box at a pose."""
            R_box = yawed(error.yaw_rad) @ T_world_x[:3, :3]
            hands = []
            for side, sign in SIGNS:
                palm = np.array([sign * (_HALF_M[0] + gap_m), 0.0, _PALM_UP_M + up_m])
                palm_world = T_world_x[:3, 3] + error.offset_m + R_box @ palm
                hands.append(with_palm(side, domain, R_box @ THUMB_UP, palm_world))
            return hands[0], hands[1]

        took, put = noise
        before, halfway = T_world_box.copy(), 0.5 * (T_world_box + T_world_goal)
        before[:3, 3] += start_m
        halfway[:3, :3] = T_world_box[:3, :3]
        halfway[:3, 3] += over_m + took.offset_m
        turned = WaypointNoise(np.zeros(3), took.yaw_rad)
        steps = [
            (0.0, beside(before, _OPEN_M + 0.02, 0.12, NO_NOISE)),
            (0.7, beside(T_world_box, _OPEN_M, 0.0, took)),
            (1.1, beside(T_world_box, _SQUEEZE_M, 0.0, took)),
            (1.3, beside(T_world_box, _SQUEEZE_M, 0.0, took)),
            (1.9, beside(T_world_box, _SQUEEZE_M, _LIFT_M, took)),
            (2.4, beside(halfway, _SQUEEZE_M, _LIFT_M, turned)),
            (2.9, beside(T_world_goal, _SQUEEZE_M, 0.06, put)),
            (3.5, beside(T_world_goal, _SQUEEZE_M, -_PUSH_M, put)),
            (3.7, beside(T_world_goal, _SQUEEZE_M, -_PUSH_M, put)),
            (4.1, beside(T_world_goal, _OPEN_M, 0.0, put)),
            (4.9, beside(T_world_goal, _OPEN_M + 0.02, 0.10, put)),
        ]
        return [Waypoint(time_s, left, right) for time_s, (left, right) in steps]

    @staticmethod
    def _is_placed(simulation: Simulation) -> bool:
        T_goal_box = _from_goal(simulation)
        x, y, z = T_goal_box[:3, 3]
        return bool(
            np.hypot(x, y) < _ASIDE_M
            and abs(z) < _MAX_HEIGHT_M
            and T_goal_box[0, 0] > _ALIGNED
            and T_goal_box[2, 2] > _UPRIGHT
            and simulation.objects_touch(_BOX, _PLATFORM)
        )

    def succeeded(self, simulation: Simulation) -> bool:
        """On the platform within 22 mm and 20°, upright, at rest, untouched."""
        return self._is_placed(simulation) and is_left(simulation, _BOX)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched by both hands; lifted by 3 cm; over the platform; on it; released."""
        touched = bool(simulation.hand_contacts()[:, _BOX].all())
        raised = bool(simulation.object_poses()[_BOX, 2] > _HALF_M[2] + _LIFTED_M)
        lifted = touched and raised and not simulation.touches_table(_BOX)
        x, y, z = _from_goal(simulation)[:3, 3]
        return (
            touched,
            lifted,
            lifted and bool(np.hypot(x, y) < _OVER_M and z > 0.0),
            self._is_placed(simulation),
            self.succeeded(simulation),
        )
