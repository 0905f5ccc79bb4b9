"""Stack Bowls: squeeze a bowl between both palms, carry it over another and nest it."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform_from_pose
from services.twin.demonstrators import HandPose, Waypoint
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import SIGNS, THUMB_UP, Draw, Noise, Poses, is_left, with_palm, yawed

_NUM_WALLS: Final = 12  # chosen: the round of a bowl in few boxes
_WALL_HALF_M: Final = (0.017, 0.024, 0.003)
_WALL_RADIUS_M, _WALL_HEIGHT_M = 0.046, 0.026
_RIM_RADIUS_M, _RIM_HEIGHT_M = 0.0606, 0.047
_NEST_M: Final = 0.014
# Height of the palm centre above the rim, to clear the lower bowl's rim when nesting.
_PALM_ABOVE_RIM_M: Final = 0.026
_SQUEEZE_M: Final = -0.014
_OPEN_M: Final = 0.045
_LIFTED_M, _OVER_BASE_M, _NESTED_M = 0.03, 0.02, 0.012
_COLOURS: Final = {"bowl_moved": "0.82 0.26 0.26 1", "bowl_base": "0.28 0.34 0.82 1"}


def _sideways_m(poses: Float64[np.ndarray, "2 7"]) -> float:
    return float(np.hypot(*(poses[0, :2] - poses[1, :2])))


def _is_nested(poses: Float64[np.ndarray, "2 7"]) -> bool:
    height_m = poses[0, 2] - poses[1, 2]
    upright = transform_from_pose(poses)[:, 2, 2]
    return bool(
        _sideways_m(poses) < _NESTED_M and 0.002 < height_m < 0.035 and upright.min() > 0.97
    )


class StackBowls:
    """Squeeze the left bowl between both palms, carry it over the right one, nest it, let go."""

    name = "stack_bowls"
    instruction = "Lift the left bowl with both hands and stack it into the right bowl."
    object_names = ("bowl_moved", "bowl_base")
    milestones = ("touched", "lifted", "over_base", "nested", "released")

    def objects_mjcf(self) -> str:
        """Two bowls, each a disc and twelve sloping walls."""
        return "".join(self._bowl(name) for name in self.object_names)

    @staticmethod
    def _bowl(name: str) -> str:
        rgba = _COLOURS[name]
        parts = [
            f'<body name="{name}"><freejoint/><geom name="{name}_floor" class="object" '
            f'type="cylinder" size="0.03 0.003" pos="0 0 0.003" mass="0.04" rgba="{rgba}"/>'
        ]
        slope = np.pi / 6
        for index in range(_NUM_WALLS):
            turn = 2 * np.pi * index / _NUM_WALLS
            outwards = np.array([np.cos(turn), np.sin(turn), 0.0])
            along = np.array([-np.sin(turn), np.cos(turn), 0.0])
            up = np.sin(slope) * outwards + np.cos(slope) * np.array([0.0, 0.0, 1.0])
            centre = _WALL_RADIUS_M * outwards + [0.0, 0.0, _WALL_HEIGHT_M]
            parts.append(
                f'<geom name="{name}_wall{index}" class="object" type="box" mass="0.01" '
                f'size="{numbers(_WALL_HALF_M)}" pos="{numbers(centre)}" '
                f'xyaxes="{numbers([*along, *up])}" rgba="{rgba}"/>'
            )
        return "".join(parts) + "</body>"

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "2 7"]:
        """One on the left, one on the right, arbitrary yaw."""
        poses = np.zeros((2, 7))
        low, high = np.array([[-0.14, -0.05], [0.08, -0.05]]), np.array([[-0.10, 0.05]] * 2)
        high[1, 0] = 0.14
        poses[:, :2] = generator.uniform(low, high)
        half_yaw = generator.uniform(0.0, np.pi, size=2)
        poses[:, 3], poses[:, 6] = np.cos(half_yaw), np.sin(half_yaw)
        return poses

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Enclose the bowl, lower, squeeze, lift, carry, nest, open, withdraw."""
        start_m, over_m = draw.uniform(-0.02, 0.02, size=(2, 3))
        rim_z = _RIM_HEIGHT_M + _PALM_ABOVE_RIM_M

        def around(
            bowl_m: np.ndarray, height_m: float, gap_m: float, yaw_rad: float
        ) -> tuple[HandPose, HandPose]:
            R_yaw = yawed(yaw_rad)
            hands = []
            for side, sign in SIGNS:
                reach = R_yaw @ np.array([sign * (_RIM_RADIUS_M + gap_m), 0.0, 0.0])
                palm = np.array([bowl_m[0], bowl_m[1], rim_z + height_m]) + reach
                hands.append(with_palm(side, domain, R_yaw @ THUMB_UP, palm))
            return hands[0], hands[1]

        source, goal = poses[0, :3], poses[1, :3]
        took, put = source + noise[0].offset_m, goal + noise[1].offset_m
        turn_take, turn_put = noise[0].yaw_rad, noise[1].yaw_rad
        steps = [
            (0.0, around(source + start_m, 0.12 + start_m[2], _OPEN_M, 0.0)),
            (0.7, around(took, 0.0, _OPEN_M, turn_take)),
            (1.15, around(took, 0.0, _SQUEEZE_M, turn_take)),
            (1.4, around(took, 0.0, _SQUEEZE_M, turn_take)),
            (2.0, around(took, 0.10, _SQUEEZE_M, turn_take)),
            (2.5, around(0.5 * (took + put) + over_m, 0.11, _SQUEEZE_M, turn_take)),
            (3.0, around(put, 0.10, _SQUEEZE_M, turn_put)),
            (3.6, around(put, _NEST_M + 0.002, _SQUEEZE_M, turn_put)),
            (3.8, around(put, _NEST_M, _SQUEEZE_M, turn_put)),
            (4.2, around(put, _NEST_M + 0.002, _OPEN_M, turn_put)),
            (4.9, around(put, 0.14, _OPEN_M + 0.01, turn_put)),
        ]
        return [Waypoint(time_s, left, right) for time_s, (left, right) in steps]

    def succeeded(self, simulation: Simulation) -> bool:
        """One bowl upright in the other, within 12 mm sideways, both at rest and untouched."""
        return _is_nested(simulation.object_poses()) and is_left(simulation)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched by a hand; lifted by 3 cm; over the other bowl; nested; released."""
        poses = simulation.object_poses()
        touched = simulation.hand_touches(0)
        raised = bool(poses[0, 2] > _LIFTED_M)
        lifted = touched and raised and not simulation.touches_table(0)
        return (
            touched,
            lifted,
            lifted and _sideways_m(poses) < _OVER_BASE_M,
            _is_nested(poses),
            self.succeeded(simulation),
        )
