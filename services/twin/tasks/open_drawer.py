"""Open Drawer: hook the fingers behind the handle of a fixed cabinet's drawer and pull."""

from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import apply, transform, transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, moved
from services.twin.hands import twin_hand
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import PALM_DOWN, Draw, Noise, Poses, flat, is_left, one_handed, yawed

# The cabinet's frame: on the table below the middle of its front; the drawer opens along -y.
_CABINET_HALF_M: Final = (0.085, 0.060, 0.042)
_FRONT_HALF_M: Final = (0.075, 0.004, 0.030)
_INSIDE_HALF_M: Final = (0.068, 0.055, 0.022)
_DRAWER_Z_M: Final = 0.046
# The handle: a bar in front of the drawer, held by a post at each end.
_BAR_RADIUS_M, _BAR_HALF_M, _BAR_Z_M = 0.006, 0.037, 0.012
_GAP_M: Final = 0.032
_FRONT_Y_M: Final = -0.008
_BAR_Y_M: Final = _FRONT_Y_M - _GAP_M - _BAR_RADIUS_M
_TRAVEL_M, _FRICTION_N, _DAMPING_N_S_M, _DRAWER_KG = 0.11, 1.0, 6.0, 0.25
_PULL_M: Final = 0.080
_OPEN_M, _MOVED_M = 0.06, 0.01
# Hook: index, middle and ring finger straight down; the little finger curled out of the way.
_HOOK_FINGERS: Final = (1, 2, 3)
_HOOK_BEND_RAD, _HOOK_TIP_BEND_RAD = 1.70, 0.35
_CURLED_RAD: Final = (0.30, 0.0, 1.90, 1.00)
_DEPTH_M: Final = 0.018
_UNLOAD_M: Final = 0.012
# Waiting position of the hand beside the drawer, which stays visible to the head camera.
_BESIDE_M: Final = np.array([0.13, -0.03, 0.0])


@lru_cache(maxsize=2)
def _hook(domain: Domain) -> Float64[np.ndarray, "20"]:
    """Joint angles with the three fingertips side by side, at the reach of the ring finger."""
    hand = twin_hand("right", domain)
    bases = np.linspace(-0.25, 1.05, 131)
    samples = np.tile(flat(domain).reshape(5, 4), (len(bases), 1, 1))
    samples[:, 4] = _CURLED_RAD
    for finger in _HOOK_FINGERS:
        samples[:, finger, 0] = bases
        samples[:, finger, 2] = _HOOK_BEND_RAD - _HOOK_TIP_BEND_RAD - bases
        samples[:, finger, 3] = _HOOK_TIP_BEND_RAD
    lower, upper = hand.kinematics.lower_rad, hand.kinematics.upper_rad
    samples = np.clip(samples.reshape(-1, 20), lower, upper)
    reach = -hand.kinematics.chain_points_m(samples)[:, :, 3, 2]
    target = reach[np.abs(bases - 0.35).argmin(), 3]
    best = samples[0].reshape(5, 4).copy()
    for finger in _HOOK_FINGERS:
        nearest = np.abs(reach[:, finger] - target).argmin()
        best[finger] = samples[nearest].reshape(5, 4)[finger]
    return best.ravel()


def _opening_m(poses: Float64[np.ndarray, "2 7"]) -> float:
    closed = apply(transform_from_pose(poses[0]), np.array([[0.0, 0.0, _DRAWER_Z_M]]))[0]
    return float(np.linalg.norm(poses[1, :3] - closed))


class OpenDrawer:
    """Hook the fingers of the right hand behind the handle, pull, let go, withdraw."""

    name = "open_drawer"
    instruction = "Pull the drawer open by its handle and let go."
    object_names = ("cabinet", "drawer")
    milestones = ("touched", "moved", "opened", "released")

    def objects_mjcf(self) -> str:
        """A fixed cabinet with its drawer; both collide with hands only."""
        alone = 'class="object" contype="0" conaffinity="1"'
        bar_z = _BAR_Z_M
        posts = "".join(
            f'<geom name="post_{side}" {alone} type="box" mass="0.01" rgba="0.95 0.85 0.20 1" '
            f'size="0.004 {0.5 * _GAP_M!r} 0.005" '
            f'pos="{numbers((sign * _BAR_HALF_M, _FRONT_Y_M - 0.5 * _GAP_M, bar_z))}"/>'
            for side, sign in (("left", -1.0), ("right", 1.0))
        )
        front_y, inside_y = _FRONT_Y_M + _FRONT_HALF_M[1], _INSIDE_HALF_M[1]
        return (
            f'<body name="cabinet" mocap="true"><geom name="cabinet_box" {alone} type="box" '
            f'size="{numbers(_CABINET_HALF_M)}" rgba="0.45 0.20 0.52 1" '
            f'pos="{numbers((0.0, _CABINET_HALF_M[1], _CABINET_HALF_M[2]))}"/>'
            f'<body name="drawer" pos="{numbers((0.0, 0.0, _DRAWER_Z_M))}">'
            f'<joint name="drawer_slide" type="slide" axis="0 -1 0" range="0 {_TRAVEL_M!r}" '
            f'frictionloss="{_FRICTION_N!r}" damping="{_DAMPING_N_S_M!r}"/>'
            f'<geom name="drawer_front" {alone} type="box" mass="{0.6 * _DRAWER_KG!r}" '
            f'size="{numbers(_FRONT_HALF_M)}" pos="{numbers((0.0, front_y, -0.004))}" '
            'rgba="0.10 0.62 0.62 1"/>'
            f'<geom name="drawer_inside" {alone} type="box" mass="{0.4 * _DRAWER_KG!r}" '
            f'size="{numbers(_INSIDE_HALF_M)}" pos="{numbers((0.0, inside_y, -0.008))}" '
            'rgba="0.06 0.36 0.38 1"/>'
            f'<geom name="drawer_handle" {alone} type="capsule" mass="0.02" '
            f'size="{numbers((_BAR_RADIUS_M, _BAR_HALF_M))}" '
            f'pos="{numbers((0.0, _BAR_Y_M, bar_z))}" xyaxes="0 1 0 0 0 1" '
            f'rgba="0.95 0.85 0.20 1"/>{posts}</body></body>'
        )

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "2 7"]:
        """Cabinet right of the centre, ±3 cm and ±0.2 rad, drawer closed."""
        x, y = generator.uniform(-0.03, 0.03, size=2)
        R = yawed(generator.uniform(-0.2, 0.2))
        q_wxyz = quaternion_from_rotation(R)
        cabinet = np.array([0.06 + x, 0.06 + y, 0.0])
        drawer = cabinet + np.array([0.0, 0.0, _DRAWER_Z_M])
        return np.array([[*cabinet, *q_wxyz], [*drawer, *q_wxyz]])

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Move over the handle, down behind it, pull, stop, up, withdraw."""
        joints = _hook(domain)
        chain = twin_hand("right", domain).kinematics.chain_points_m(joints[None])[0]
        # Centre of the three hooking fingertips in the wrist frame.
        tips = chain[list(_HOOK_FINGERS), 3].mean(axis=0)
        start_m, away_m = draw.uniform(-0.02, 0.02, size=(2, 3))
        T_world_cabinet = transform_from_pose(poses[0])
        bar_z = _DRAWER_Z_M + _BAR_Z_M
        gap = np.array([0.0, _FRONT_Y_M - 0.5 * _GAP_M, bar_z])

        def hand(offset_m: tuple[float, float], error: WaypointNoise) -> HandPose:
            """Fingertips at the gap, shifted along the cabinet's y and upwards."""
            R = yawed(error.yaw_rad) @ T_world_cabinet[:3, :3] @ PALM_DOWN
            tip = apply(T_world_cabinet, (gap + np.array([0.0, *offset_m]))[None])[0]
            return HandPose(transform(R, tip + error.offset_m - R @ tips), joints)

        took, put = noise
        above, away = hand((-0.03, 0.09), NO_NOISE), hand((-_PULL_M - 0.04, 0.09), put)
        path = [
            (0.0, moved(above, start_m + _BESIDE_M)),
            (0.7, hand((0.0, 0.045), took)),
            (1.15, hand((0.0, -_DEPTH_M), took)),
            (1.3, hand((0.0, -_DEPTH_M), took)),
            (2.6, hand((-_PULL_M, -_DEPTH_M), put)),
            (2.9, hand((-_PULL_M, -_DEPTH_M), put)),
            (3.2, hand((-_PULL_M + _UNLOAD_M, -_DEPTH_M), put)),
            (3.8, hand((-_PULL_M + _UNLOAD_M, 0.06), put)),
            (4.7, moved(away, away_m + _BESIDE_M)),
        ]
        return one_handed(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """Open by 6 cm or more, at rest, untouched."""
        return _opening_m(simulation.object_poses()) > _OPEN_M and is_left(simulation)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Drawer touched by a hand; open by 1 cm; open by 6 cm; released and at rest."""
        opening_m = _opening_m(simulation.object_poses())
        return (
            simulation.hand_touches(1),
            opening_m > _MOVED_M,
            opening_m > _OPEN_M,
            self.succeeded(simulation),
        )
