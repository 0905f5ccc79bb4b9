"""Insert Peg: grasp a standing peg from the side and insert it into the hole of a block."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform_from_pose
from services.twin.demonstrators import NO_NOISE, Waypoint, moved
from services.twin.grasps import CylinderGrasp
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import THUMB_UP, Draw, Grip, Noise, Poses, is_left, one_handed, yawed

_RADIUS_M, _HALF_LENGTH_M, _FOOT_HALF_M = 0.022, 0.090, 0.020
# Grasp height above the peg's centre, to keep the hand clear of the block.
_GRIP_M: Final = 0.035
# Clearance on each side of the peg in the square hole, and widening by the chamfer at the top.
_CLEARANCE_M, _CHAMFER_M, _CHAMFER_RAD = 0.002, 0.008, 0.9
_HOLE_HALF_M: Final = _RADIUS_M + _CLEARANCE_M
_BLOCK_HALF_M, _WALL_HEIGHT_M, _PLATE_HALF_M = 0.056, 0.036, 0.003
# The block is smooth, so that its chamfer guides; the peg rolls badly, so that it stays on the
# table when dropped.
_BLOCK_CONTACT: Final = 'friction="0.25 0.005 0.0001" priority="1"'
_PEG_CONTACT: Final = 'condim="6" friction="1 0.005 0.003"'
_COLOURS: Final = {
    "peg": "0.74 0.14 0.52 1",
    "foot": "0.94 0.86 0.20 1",
    "wall": "0.16 0.20 0.30 1",
    "chamfer": "0.10 0.70 0.72 1",
}
# The thumb presses opposite the middle of the fingers: further out it would rotate the peg.
_GRASPS: Final[dict[Domain, CylinderGrasp]] = {
    "robot": CylinderGrasp(_RADIUS_M, 0.035, -0.095, 0.45, 0.40, 0.020, 0.06),
    "human": CylinderGrasp(_RADIUS_M, 0.039, -0.105, 0.45, 0.40, 0.020, 0.06),
}
_SQUEEZE_N: Final = 6.0  # chosen: holds the peg while it is inserted
_OPEN_M: Final = 0.020  # chosen: gap around the object before the grasp
_LIFT_M: Final = 0.075  # chosen: clears the block
# Commanded depth below the table, so that the compliant wrist pushes the peg in.
_PUSH_M: Final = 0.010
# Position of the peg's foot in the grasp frame when held, determined by closing the hand once.
_HELD_FEET_M: Final[dict[Domain, tuple[float, float, float]]] = {
    "robot": (-0.128, -0.0061, -0.0014),
    "human": (-0.127, -0.0025, 0.0014),
}
# Success: distances of the foot to the table and to the hole's axis; upright within 10°.
_DEPTH_M, _ASIDE_M, _UPRIGHT = 0.010, _CLEARANCE_M + 0.003, 0.985
_LIFTED_M, _OVER_HOLE_M = 0.03, 0.02


def _wall(index: int) -> str:
    """A wall of the block and the chamfer plate on top of it, for one of four sides."""
    turn, up = 0.5 * np.pi * index, np.array([0.0, 0.0, 1.0])
    outwards = np.array([np.cos(turn), np.sin(turn), 0.0])
    along = np.array([-np.sin(turn), np.cos(turn), 0.0])
    # Walls are arranged like a pinwheel: each ends at the side of the next.
    half_m = 0.5 * (_BLOCK_HALF_M - _HOLE_HALF_M)
    middle_m = 0.5 * (_BLOCK_HALF_M + _HOLE_HALF_M)
    centre = middle_m * outwards + half_m * along + 0.5 * _WALL_HEIGHT_M * up
    slope = np.cos(_CHAMFER_RAD) * outwards + np.sin(_CHAMFER_RAD) * up
    normal = np.cos(_CHAMFER_RAD) * up - np.sin(_CHAMFER_RAD) * outwards
    half_slope_m = 0.5 * _CHAMFER_M / float(np.cos(_CHAMFER_RAD))
    edge = _HOLE_HALF_M * outwards + _WALL_HEIGHT_M * up
    plate = edge + half_slope_m * slope - _PLATE_HALF_M * normal
    return (
        f'<geom name="socket_wall{index}" class="object" type="box" mass="0.3" '
        f'size="{numbers((half_m, middle_m, 0.5 * _WALL_HEIGHT_M))}" pos="{numbers(centre)}" '
        f'xyaxes="{numbers([*outwards, *along])}" {_BLOCK_CONTACT} rgba="{_COLOURS["wall"]}"/>'
        f'<geom name="socket_chamfer{index}" class="object" type="box" mass="0.05" '
        f'size="{numbers((half_slope_m, _HOLE_HALF_M + _CHAMFER_M, _PLATE_HALF_M))}" '
        f'pos="{numbers(plate)}" xyaxes="{numbers([*slope, *along])}" {_BLOCK_CONTACT} '
        f'rgba="{_COLOURS["chamfer"]}"/>'
    )


def _foot_in_socket_m(poses: Float64[np.ndarray, "2 7"]) -> Float64[np.ndarray, "3"]:
    """Centre of the peg's lower end in the socket's frame."""
    T_world_peg, T_world_socket = transform_from_pose(poses)
    foot_world = T_world_peg[:3, 3] - _HALF_LENGTH_M * T_world_peg[:3, 2]
    return T_world_socket[:3, :3].T @ (foot_world - T_world_socket[:3, 3])


def _is_inserted(poses: Float64[np.ndarray, "2 7"]) -> bool:
    foot = _foot_in_socket_m(poses)
    upright = transform_from_pose(poses[0])[2, 2]
    return bool(foot[2] < _DEPTH_M and np.abs(foot[:2]).max() < _ASIDE_M and upright > _UPRIGHT)


class InsertPeg:
    """Grasp the standing peg from the side, lift it over the block, push it in, let go."""

    name = "insert_peg"
    instruction = "Pick up the peg and insert it into the hole of the block."
    object_names = ("peg", "socket")
    milestones = ("touched", "lifted", "over_hole", "inserted", "released")

    def objects_mjcf(self) -> str:
        """A cylinder with a foot of another colour; a fixed block of four walls and chamfers."""
        foot_z, shaft_half = _FOOT_HALF_M - _HALF_LENGTH_M, _HALF_LENGTH_M - _FOOT_HALF_M
        walls = "".join(_wall(index) for index in range(4))
        return (
            '<body name="peg"><freejoint/>'
            '<geom name="peg_shaft" class="object" type="cylinder" mass="0.06" '
            f'size="{numbers((_RADIUS_M, shaft_half))}" pos="0 0 {_FOOT_HALF_M!r}" '
            f'{_PEG_CONTACT} rgba="{_COLOURS["peg"]}"/>'
            '<geom name="peg_foot" class="object" type="cylinder" mass="0.08" '
            f'size="{numbers((_RADIUS_M, _FOOT_HALF_M))}" pos="0 0 {foot_z!r}" '
            f'{_PEG_CONTACT} rgba="{_COLOURS["foot"]}"/></body>'
            f'<body name="socket" mocap="true">{walls}</body>'
        )

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "2 7"]:
        """Peg on the right, block left of the middle, each ±3 cm; the block turned by ±0.25 rad."""
        poses = np.zeros((2, 7))
        middles = np.array([[0.10, 0.0], [-0.08, 0.03]])
        poses[:, :2] = middles + generator.uniform(-0.03, 0.03, size=(2, 2))
        poses[0, 2:4] = _HALF_LENGTH_M, 1.0
        half_yaw = 0.5 * generator.uniform(-0.25, 0.25)
        poses[1, 3], poses[1, 6] = np.cos(half_yaw), np.sin(half_yaw)
        return poses

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Approach, enclose, close, lift, move over the hole, insert, open, withdraw."""
        grip = Grip(_GRASPS[domain], domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)
        start_m, over_m = draw.uniform(-0.02, 0.02, size=(2, 3))

        peg_m = poses[0, :3] + [0.0, 0.0, _GRIP_M]
        beside = moved(grip.at(peg_m, NO_NOISE), start_m + np.array([0.12, -0.02, 0.03]))
        reach = grip.at(peg_m, noise[0])
        took = grip.pressed(reach)
        hole_m, R_hole = poses[1, :3] + noise[1].offset_m, yawed(noise[1].yaw_rad) @ THUMB_UP
        left = grip.around(R_hole, hole_m, held_m=_HELD_FEET_M[domain])
        put = grip.pressed(left)
        path = [
            (0.0, beside),
            (0.8, reach),
            (1.15, took),
            (1.3, took),
            (1.8, moved(took, [0.0, 0.0, _LIFT_M])),
            (2.5, moved(put, 0.3 * over_m + [0.0, 0.0, _LIFT_M])),
            (2.8, moved(put, [0.0, 0.0, 0.055])),
            (3.4, moved(put, [0.0, 0.0, -_PUSH_M])),
            (3.6, moved(put, [0.0, 0.0, -_PUSH_M])),
            (4.0, left),
            (4.8, moved(left, [0.13, -0.02, 0.03])),
        ]
        return one_handed(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """Foot within 1 cm of the hole's bottom, upright within 10°, at rest, untouched."""
        return _is_inserted(simulation.object_poses()) and is_left(simulation)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched by a hand; lifted by 3 cm; foot over the hole; inserted; released."""
        poses = simulation.object_poses()
        foot = _foot_in_socket_m(poses)
        touched = simulation.hand_touches(0)
        lifted = touched and bool(foot[2] > _LIFTED_M) and not simulation.touches_table(0)
        return (
            touched,
            lifted,
            lifted and float(np.hypot(foot[0], foot[1])) < _OVER_HOLE_M,
            _is_inserted(poses),
            self.succeeded(simulation),
        )
