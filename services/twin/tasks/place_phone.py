"""Place Phone: pinch a phone by its long edges, lift it off its pad and lean it into a stand."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import apply, invert, transform, transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from services.twin.demonstrators import HandPose, Waypoint, WaypointNoise, moved
from services.twin.grasps import CylinderGrasp
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import PALM_DOWN, Draw, Grip, Noise, Poses, is_left, one_handed, yawed

# Phone frame: x across, y towards its top, z out of the screen; origin at its centre.
_PHONE_HALF_M: Final = (0.036, 0.075, 0.0045)
# The pad is smaller than the phone, so that fingertips get around the phone's long edges.
_PAD_HALF_M: Final = (0.024, 0.055, 0.008)
_PHONE_Z_M: Final = 2 * _PAD_HALF_M[2] + _PHONE_HALF_M[2]
# Cradle frame: like the phone's, with its origin in the corner of ledge and back rest.
_LEAN_RAD: Final = np.deg2rad(60.0)
_T_STAND_CRADLE: Final = transform(
    rotation_from_vector(np.array([_LEAN_RAD, 0.0, 0.0])), np.array([0.0, 0.0, 0.026])
)
_SEATED_M: Final = np.array([0.0, _PHONE_HALF_M[1], _PHONE_HALF_M[2]])
# The pocket at its floor, and how far its cheeks and its lip lean outwards.
_SLOT_M, _LIP_M = 0.016, 0.012
_CHEEK_GAP_M, _CHEEK_M = 0.007, 0.032
_FLARE_RAD: Final = np.deg2rad(25.0)
_WALL_M: Final = 0.005
_STAND_FRICTION: Final = 0.12
_GRASPS: Final[dict[Domain, CylinderGrasp]] = {
    "robot": CylinderGrasp(_PHONE_HALF_M[0], 0.052, -0.085, 0.40, 0.0, 0.025, _PHONE_Z_M),
    "human": CylinderGrasp(_PHONE_HALF_M[0], 0.052, -0.085, 0.40, 0.0, 0.025, _PHONE_Z_M),
}
# Maximum distance from the seat for a seated phone, and for one over the stand.
_SEATED_WITHIN_M: Final = np.array([0.014, 0.006, 0.008])
_SEATED_RAD: Final = 0.2
_LIFTED_M, _NEAR_M = 0.03, 0.08
_SQUEEZE_N: Final = 8.0
_OPEN_M: Final = 0.018
# Position of the phone's centre in the hand, along its own y.
_ALONG_M: Final = -0.010
# Shift of the phone in the closed hand, caused by the pressure of thumb and fingers: offset and
# rotation vector in its own frame, determined by closing the hand.
_HELD: Final[dict[Domain, tuple[tuple[float, float, float], tuple[float, float, float]]]] = {
    "robot": ((0.0011, -0.0053, -0.0008), (-0.068, 0.117, -0.216)),
    "human": ((0.0001, -0.0049, -0.0019), (-0.072, 0.077, -0.156)),
}
# Fingers point to the left over a phone whose top points away from the viewer.
_FINGERS_LEFT: Final = yawed(0.5 * np.pi) @ PALM_DOWN


def _wall(
    name: str,
    T_stand_foot: Float64[np.ndarray, "4 4"],
    low_m: tuple[float, float, float],
    high_m: tuple[float, float, float],
) -> str:
    """A box of the stand between two corners given in a local frame."""
    low, high = np.array(low_m), np.array(high_m)
    centre = apply(T_stand_foot, 0.5 * (low + high)[None])[0]
    return (
        f'<geom name="stand_{name}" class="object" type="box" size="{numbers(0.5 * (high - low))}" '
        f'pos="{numbers(centre)}" quat="{numbers(quaternion_from_rotation(T_stand_foot[:3, :3]))}" '
        f'friction="{_STAND_FRICTION!r} 0.005 0.0001" priority="1" rgba="0.62 0.12 0.30 1"/>'
    )


def _stand() -> str:
    """A base, a back rest and a ledge, with cheeks and a lip that lean away from the pocket."""
    T, across, wall = _T_STAND_CRADLE, _PHONE_HALF_M[0] + _CHEEK_GAP_M, _WALL_M

    def leaning(rotation_rad: list[float], foot_m: list[float]) -> Float64[np.ndarray, "4 4"]:
        return T @ transform(rotation_from_vector(np.array(rotation_rad)), np.array(foot_m))

    right = leaning([0.0, 0.0, -_FLARE_RAD], [across, 0.0, 0.0])
    left = leaning([0.0, 0.0, _FLARE_RAD], [-across, 0.0, 0.0])
    lip = leaning([_FLARE_RAD, 0.0, 0.0], [0.0, 0.0, _SLOT_M])
    parts = [
        _wall("base", np.eye(4), (-0.044, -0.030, 0.0), (0.044, 0.070, 0.008)),
        _wall("back", T, (-0.022, -0.020, -0.006), (0.022, 0.105, 0.0)),
        _wall("ledge", T, (-across, -wall, 0.0), (across, 0.0, _SLOT_M)),
        _wall("lip", lip, (-across, -wall, 0.0), (across, _LIP_M, wall)),
        _wall("right", right, (0.0, -wall, -wall), (wall, _CHEEK_M, _SLOT_M)),
        _wall("left", left, (-wall, -wall, -wall), (0.0, _CHEEK_M, _SLOT_M)),
    ]
    return f'<body name="stand" mocap="true">{"".join(parts)}</body>'


def _in_cradle(simulation: Simulation) -> Float64[np.ndarray, "4 4"]:
    T_world_phone, T_world_stand, _ = transform_from_pose(simulation.object_poses())
    return invert(T_world_stand @ _T_STAND_CRADLE) @ T_world_phone


def _is_seated(T_cradle_phone: Float64[np.ndarray, "4 4"]) -> bool:
    offset_m = np.abs(T_cradle_phone[:3, 3] - _SEATED_M)
    turned = np.trace(T_cradle_phone[:3, :3]) < 1 + 2 * np.cos(_SEATED_RAD)
    return bool((offset_m < _SEATED_WITHIN_M).all() and not turned)


class PlacePhone:
    """Pinch the phone by its long edges, lift it, lean it into the stand, let go."""

    name = "place_phone"
    instruction = "Pick up the phone and place it on the phone stand."
    object_names = ("phone", "stand", "pad")
    milestones = ("touched", "lifted", "over_stand", "placed", "released")

    def objects_mjcf(self) -> str:
        """A free phone, and a fixed stand and pad."""
        half = np.array(_PHONE_HALF_M)
        screen = half * [0.92, 0.94, 0.1]
        return (
            '<body name="phone"><freejoint/>'
            f'<geom name="phone_body" class="object" type="box" mass="0.15" '
            f'size="{numbers(half)}" rgba="0.10 0.10 0.55 1"/>'
            f'<geom name="phone_screen" type="box" contype="0" conaffinity="0" mass="0" '
            f'size="{numbers(screen)}" pos="0 0 {_PHONE_HALF_M[2]!r}" '
            f'rgba="0.20 0.85 0.95 1"/></body>{_stand()}'
            '<body name="pad" mocap="true">'
            f'<geom name="pad_body" class="object" type="box" size="{numbers(_PAD_HALF_M)}" '
            f'pos="0 0 {_PAD_HALF_M[2]!r}" rgba="0.9 0.9 0.9 1"/></body>'
        )

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "3 7"]:
        """Phone on its pad to the right, stand to the left, each ±3 cm and ±0.25 rad."""
        poses = np.zeros((3, 7))
        offsets = generator.uniform(-0.03, 0.03, size=(2, 2))
        half_yaw = 0.5 * generator.uniform(-0.25, 0.25, size=2)
        poses[0, :2] = offsets[0] + [0.12, -0.02]
        poses[1, :2] = offsets[1] + [-0.08, 0.05]
        poses[:2, 3], poses[:2, 6] = np.cos(half_yaw), np.sin(half_yaw)
        poses[2] = poses[0]
        poses[0, 2] = _PHONE_Z_M
        return poses

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Move over it, down, close, lift, lean, lower into the stand, open, withdraw."""
        grip = Grip(_GRASPS[domain], domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)
        T_world_phone, T_world_stand, _ = transform_from_pose(poses)
        # Wrist in the phone's frame: palm over the screen, fingers across it.
        held = grip.around(_FINGERS_LEFT, np.zeros(3), held_m=(-_ALONG_M, 0.0, 0.0))
        held_m, held_rad = np.array(_HELD[domain])
        T_held_phone = invert(transform(rotation_from_vector(held_rad), held_m))
        start_m, over_m = draw.uniform(-0.02, 0.02, size=(2, 3))

        def misread(T: np.ndarray, error: WaypointNoise) -> np.ndarray:
            return transform(yawed(error.yaw_rad) @ T[:3, :3], T[:3, 3] + error.offset_m)

        def hand(T: np.ndarray, joints: np.ndarray) -> HandPose:
            return HandPose(T @ held.T_world_wrist, joints)

        above = moved(hand(T_world_phone, grip.open_rad), start_m + np.array([0.03, -0.03, 0.12]))
        took = misread(T_world_phone, noise[0])
        put = misread(T_world_stand, noise[1]) @ _T_STAND_CRADLE

        def seat(up_m: float, off_m: float, joints: np.ndarray) -> HandPose:
            offset = np.array([0.0, up_m, off_m])
            return hand(put @ transform(np.eye(3), _SEATED_M + offset) @ T_held_phone, joints)

        path = [
            (0.0, above),
            (0.8, hand(took, grip.open_rad)),
            (1.15, hand(took, grip.press_rad)),
            (1.3, hand(took, grip.press_rad)),
            (1.8, moved(hand(took, grip.press_rad), [0.0, 0.0, 0.10])),
            (2.7, moved(seat(0.05, 0.04, grip.press_rad), over_m * 0.5)),
            (3.2, seat(0.012, 0.005, grip.press_rad)),
            (3.5, seat(0.0, 0.003, grip.press_rad)),
            (3.65, seat(0.0, 0.003, grip.press_rad)),
            (4.05, seat(0.0, 0.003, grip.open_rad)),
            (4.45, seat(0.0, 0.07, grip.open_rad)),
            (5.0, moved(seat(0.0, 0.07, grip.open_rad), [0.16, -0.04, 0.02])),
        ]
        return one_handed(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """Seated in the stand, at rest, untouched."""
        return _is_seated(_in_cradle(simulation)) and is_left(simulation, 0)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched by a hand; lifted by 3 cm; over the stand; seated; released."""
        T_cradle_phone = _in_cradle(simulation)
        height_m = simulation.object_poses()[0, 2]
        touched = simulation.hand_touches(0)
        lifted = bool(touched and height_m > _PHONE_Z_M + _LIFTED_M)
        return (
            touched,
            lifted,
            lifted and bool(np.linalg.norm(T_cradle_phone[:3, 3] - _SEATED_M) < _NEAR_M),
            _is_seated(T_cradle_phone),
            self.succeeded(simulation),
        )
