"""Strike Bell: hit a spring-loaded plunger so hard that it throws a flag over."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import invert, transform, transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, moved
from services.twin.hands import twin_hand
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import PALM_DOWN, Draw, Noise, Poses, flat, is_left, one_handed, yawed

# The bell's frame: on the table below the plunger, y away from the viewer. Top of the plunger,
# its travel and the part of it after which its arm meets the flag's crank.
_TOP_M, _TRAVEL_M, _FREE_M = 0.075, 0.010, 0.004
_CAP_RADIUS_M, _CAP_HALF_M, _ROD_RADIUS_M = 0.016, 0.006, 0.007
_STIFFNESS_N_M, _DAMPING_N_S_M, _PLUNGER_KG = 500.0, 3.0, 0.05
# The flag: a pole with a plate, and a crank that the plunger's arm presses down. Friction holds it
# where it is, so a slow push leaves it far from where a hit throws it.
_HINGE_M: Final = np.array([0.080, -0.012, 0.035])
_CRANK_M, _ARM_HALF_M = 0.020, 0.004
_POLE_M: Final = 0.075
_FLAG_FRICTION_NM, _FLAG_RANGE_RAD = 0.009, 1.45
# Posts on both sides of the palm, that stop a hand beside the plunger: inner sides and height.
_POSTS_M: Final = (-0.069, 0.044)
_POST_HALF_M: Final = (0.006, 0.018, 0.5 * (_TOP_M + 0.003))
# Cameras only see geoms that could collide; nothing has this bit.
_SEEN: Final = 'contype="0" conaffinity="8"'
_COLOURS: Final = {
    "stand": "0.22 0.26 0.36 1",
    "bell": "0.86 0.66 0.16 1",
    "plunger": "0.78 0.12 0.12 1",
    "flag": "0.10 0.62 0.34 1",
}
# Where the plunger meets the palm: nearer to the little finger, clear of the base of the thumb.
_PALM_X_M: Final = -0.018
_ABOVE_M, _BELOW_M = 0.090, 0.035
_AWAY_M: Final = np.array([0.13, -0.06, 0.02])
_STRUCK_RAD, _RUNG_RAD = 0.1, 1.0
_STAND, _PLUNGER, _FLAG = range(3)


def _flag_rad(simulation: Simulation) -> float:
    """Angle of the flag from upright, outwards."""
    Ts = transform_from_pose(simulation.object_poses())
    z_axis = (invert(Ts[_STAND]) @ Ts[_FLAG])[:3, 2]
    return float(np.arctan2(z_axis[0], z_axis[2]))


class StrikeBell:
    """Strike the plunger with the right palm from above, and withdraw at once."""

    name = "strike_bell"
    instruction = "Strike the bell hard enough to throw the flag over."
    object_names = ("stand", "plunger", "flag")
    milestones = ("touched", "struck", "rung", "released")

    def objects_mjcf(self) -> str:
        """A fixed stand with posts and a bell, the plunger, and the flag that it pushes."""
        alone = 'class="object" contype="0" conaffinity="1"'
        posts = "".join(
            f'<geom name="stand_post_{side}" {alone} type="box" size="{numbers(_POST_HALF_M)}" '
            f'pos="{numbers((inner + sign * _POST_HALF_M[0], 0.026, _POST_HALF_M[2]))}" '
            f'rgba="{_COLOURS["stand"]}"/>'
            for side, sign, inner in zip(("left", "right"), (-1.0, 1.0), _POSTS_M, strict=True)
        )
        return (
            f'<body name="stand" mocap="true"><geom name="stand_base" {alone} type="box" '
            f'size="0.085 0.045 0.006" pos="0 0 0.006" rgba="{_COLOURS["stand"]}"/>{posts}'
            f'<geom name="stand_bell" {alone} type="ellipsoid" size="0.030 0.030 0.034" '
            f'pos="0 0 0.012" rgba="{_COLOURS["bell"]}"/>{self._plunger()}{self._flag()}</body>'
        )

    @staticmethod
    def _plunger() -> str:
        rod_half, arm_half = 0.5 * (_TOP_M - 0.03), 0.5 * (_HINGE_M[0] + _CRANK_M)
        arm = (arm_half, _HINGE_M[1], _HINGE_M[2] - _TOP_M + 2 * _ARM_HALF_M + _FREE_M)
        return (
            f'<body name="plunger" pos="0 0 {_TOP_M!r}" gravcomp="1"><joint name="plunger_slide" '
            f'type="slide" axis="0 0 -1" range="0 {_TRAVEL_M!r}" solreflimit="0.006 1" '
            f'stiffness="{_STIFFNESS_N_M!r}" damping="{_DAMPING_N_S_M!r}"/>'
            '<geom name="plunger_cap" class="object" type="cylinder" contype="0" conaffinity="1" '
            f'mass="{0.6 * _PLUNGER_KG!r}" size="{numbers((_CAP_RADIUS_M, _CAP_HALF_M))}" '
            f'pos="0 0 {-_CAP_HALF_M!r}" rgba="{_COLOURS["plunger"]}"/>'
            '<geom name="plunger_rod" class="object" type="cylinder" contype="0" conaffinity="1" '
            f'mass="{0.2 * _PLUNGER_KG!r}" size="{numbers((_ROD_RADIUS_M, rod_half))}" '
            f'pos="0 0 {-rod_half!r}" rgba="{_COLOURS["plunger"]}"/>'
            f'<geom name="plunger_arm" class="object" type="box" {_SEEN} '
            f'mass="{0.1 * _PLUNGER_KG!r}" size="{numbers((arm_half, 0.006, _ARM_HALF_M))}" '
            f'pos="{numbers(arm)}" rgba="{_COLOURS["plunger"]}"/>'
            '<geom name="plunger_knob" class="object" type="sphere" contype="4" conaffinity="0" '
            f'solref="0.004 1" mass="{0.1 * _PLUNGER_KG!r}" size="{_ARM_HALF_M!r}" '
            f'pos="{numbers((2 * arm_half - _ARM_HALF_M, *arm[1:]))}" '
            f'rgba="{_COLOURS["plunger"]}"/></body>'
        )

    @staticmethod
    def _flag() -> str:
        crank = (0.5 * _CRANK_M, 0.0, 0.0)
        return (
            f'<body name="flag" pos="{numbers(_HINGE_M)}" gravcomp="1"><joint name="flag_hinge" '
            f'type="hinge" axis="0 1 0" range="0 {_FLAG_RANGE_RAD!r}" '
            f'frictionloss="{_FLAG_FRICTION_NM!r}"/>'
            '<geom name="flag_crank" class="object" type="box" contype="0" conaffinity="4" '
            f'mass="0.002" size="{numbers((0.5 * _CRANK_M, 0.006, _ARM_HALF_M))}" '
            f'pos="{numbers(crank)}" rgba="{_COLOURS["flag"]}" solref="0.004 1"/>'
            f'<geom name="flag_pole" class="object" {_SEEN} type="box" mass="0.003" '
            f'size="{numbers((0.003, 0.003, 0.5 * _POLE_M))}" pos="0 -0.010 {0.5 * _POLE_M!r}" '
            f'rgba="{_COLOURS["flag"]}"/>'
            f'<geom name="flag_plate" class="object" {_SEEN} type="box" mass="0.005" '
            f'size="0.018 0.003 0.016" pos="0.018 -0.010 {_POLE_M - 0.016!r}" '
            f'rgba="{_COLOURS["flag"]}"/></body>'
        )

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "3 7"]:
        """Left of the centre, ±3 cm and ±0.2 rad, plunger up, flag upright."""
        x, y = generator.uniform(-0.03, 0.03, size=2)
        R = yawed(float(generator.uniform(-0.2, 0.2)))
        stand = np.array([x, 0.04 + y, 0.0])
        offsets = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, _TOP_M], R @ _HINGE_M])
        parts = stand + offsets
        return np.concatenate([parts, np.tile(quaternion_from_rotation(R), (3, 1))], axis=1)

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Move over the plunger, strike, withdraw upwards and to the right."""
        start_m, away_m = draw.uniform(-0.02, 0.02, size=(2, 3))
        shape = twin_hand("right", domain).shape
        palm = np.array([_PALM_X_M, shape.palm_face_m, shape.palm_z_m])
        T_world_stand = transform_from_pose(poses[_STAND])

        def hand(up_m: float, error: WaypointNoise) -> HandPose:
            """Palm at a height above the plunger's top."""
            R = yawed(error.yaw_rad) @ T_world_stand[:3, :3] @ PALM_DOWN
            top = T_world_stand[:3, 3] + error.offset_m + [0.0, 0.0, _TOP_M + up_m]
            return HandPose(transform(R, top - R @ palm), flat(domain))

        aim = WaypointNoise(noise[0].offset_m + 0.3 * noise[1].offset_m, noise[0].yaw_rad)
        before = moved(hand(_ABOVE_M, NO_NOISE), start_m)
        path = [
            (0.0, moved(before, _AWAY_M)),
            (1.0, hand(_ABOVE_M, aim)),
            (1.6, hand(_ABOVE_M + 0.01, aim)),
            (1.86, hand(-_BELOW_M, aim)),
            (1.93, hand(-_BELOW_M, aim)),
            (2.25, hand(_ABOVE_M, aim)),
            (3.2, moved(hand(_ABOVE_M, aim), away_m + _AWAY_M)),
            (4.8, moved(hand(_ABOVE_M, aim), 1.1 * (away_m + _AWAY_M))),
        ]
        return one_handed(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """The flag thrown over, the plunger up again, all at rest and untouched."""
        heights_m = simulation.object_poses()[:, 2]
        depth_m = _TOP_M - (heights_m[_PLUNGER] - heights_m[_STAND])
        is_up = bool(depth_m < 0.1 * _TRAVEL_M)
        return _flag_rad(simulation) > _RUNG_RAD and is_up and is_left(simulation)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Plunger touched by a hand; flag moved; flag thrown over; released and at rest.

        The flag remembers what happened between two grid steps.
        """
        flag_rad = _flag_rad(simulation)
        return (
            simulation.hand_touches(_PLUNGER),
            flag_rad > _STRUCK_RAD,
            flag_rad > _RUNG_RAD,
            self.succeeded(simulation),
        )
