"""Squeeze Ball: squeeze a soft ball between thumb and fingers and let go."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import invert, transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation
from services.twin.demonstrators import NO_NOISE, HandPose, Waypoint, WaypointNoise, bent, moved
from services.twin.grasps import CylinderGrasp
from services.twin.names import Domain
from services.twin.scene import numbers
from services.twin.simulation import Simulation
from services.twin.tasks.task import THUMB_UP, Draw, Grip, Noise, Poses, is_left, one_handed, yawed

# The ball's frame: on the table below it. The ball is two halves on springs along y. It is turned,
# so that the viewer sees the hand behind the ball, and both pins.
_TURNED_RAD: Final = 0.9
_RADIUS_M, _HALF_HEIGHT_M, _CENTRE_Z_M = 0.032, 0.042, 0.115
_HALF_Y_M: Final = 0.014
_STIFFNESS_N_M, _DAMPING_N_S_M, _TRAVEL_M, _HALF_KG = 500.0, 6.0, 0.014, 0.03
# Above the ball, each half pushes a pin inwards by a fin; friction holds the pins where they are.
_PIN_Z_M, _FIN_Y_M, _FIN_HALF_M = 0.056, 0.030, 0.002
_PIN_HALF_M: Final = (0.007, 0.004, 0.010)
_PIN_Y_M: Final = _FIN_Y_M - _FIN_HALF_M - _PIN_HALF_M[1] - 0.0005
_PIN_FRICTION_N: Final = 0.3
# Cameras only see geoms that could collide; nothing has this bit.
_SEEN: Final = 'class="object" contype="0" conaffinity="8"'
_COLOURS: Final = {
    "ball": ("0.86 0.36 0.20 1", "0.70 0.24 0.14 1"),
    "stand": "0.22 0.26 0.36 1",
    "pin": "0.95 0.90 0.25 1",
}
_GRASPS: Final[dict[Domain, CylinderGrasp]] = {
    "robot": CylinderGrasp(_RADIUS_M, 0.043, -0.095, 0.45, 0.40, 0.0, 0.2),
    "human": CylinderGrasp(_RADIUS_M, 0.047, -0.105, 0.45, 0.40, 0.0, 0.2),
}
_SQUEEZE_N: Final = 12.0  # chosen: presses both pins in by _SQUEEZED_M
_OPEN_M: Final = 0.020  # chosen: gap around the object before the grasp
# Both pins are pushed in by this much at least.
_PRESSED_M, _SQUEEZED_M = 0.002, 0.0045
_SIDES: Final = (("near", 1.0), ("far", -1.0))


def _inwards_m(simulation: Simulation) -> float:
    """How far both pins at least are inside their first positions."""
    Ts = transform_from_pose(simulation.object_poses())
    y_m = (invert(Ts[0]) @ Ts[1:])[:, 1, 3]
    return float((_PIN_Y_M + y_m * [inwards for _, inwards in _SIDES]).min())


class SqueezeBall:
    """Squeeze the ball between thumb and fingers of the right hand, hold, let go, withdraw."""

    name = "squeeze_ball"
    instruction = "Squeeze the ball from both sides until its pins have moved in, and let go."
    object_names = ("ball", "pin_near", "pin_far")
    milestones = ("touched", "pressed", "squeezed", "released")

    def objects_mjcf(self) -> str:
        """A fixed stand with the halves of the ball, and their pins, that slide inwards."""
        rail_z = _CENTRE_Z_M + _PIN_Z_M - _PIN_HALF_M[2] - 0.002
        parts = [
            '<body name="ball" mocap="true"><geom name="stand_foot" class="object" '
            'type="cylinder" contype="0" conaffinity="1" size="0.045 0.005" pos="0 0 0.005" '
            f'rgba="{_COLOURS["stand"]}"/><geom name="stand_column" {_SEEN} type="cylinder" '
            f'size="0.007 {0.5 * rail_z!r}" pos="0 0 {0.5 * rail_z!r}" '
            f'rgba="{_COLOURS["stand"]}"/><geom name="stand_rail" {_SEEN} type="box" '
            f'size="0.005 0.028 0.002" pos="0 0 {rail_z!r}" rgba="{_COLOURS["stand"]}"/>'
        ]
        for (side, inwards), colour in zip(_SIDES, _COLOURS["ball"], strict=True):
            half = (_RADIUS_M, _RADIUS_M - _HALF_Y_M, _HALF_HEIGHT_M)
            fin_half_z = 0.5 * (_PIN_Z_M + _PIN_HALF_M[2] - 0.018)
            fin = (0.0, -inwards * (_FIN_Y_M - _HALF_Y_M), 0.018 + fin_half_z)
            slide = f'type="slide" axis="0 {inwards!r} 0" range="0 {_TRAVEL_M!r}"'
            parts += [
                f'<body name="ball_{side}" pos="0 {-inwards * _HALF_Y_M!r} {_CENTRE_Z_M!r}">'
                f'<joint name="ball_{side}_slide" {slide} stiffness="{_STIFFNESS_N_M!r}" '
                f'damping="{_DAMPING_N_S_M!r}"/><geom name="ball_{side}_half" class="object" '
                f'type="ellipsoid" contype="0" conaffinity="1" mass="{_HALF_KG!r}" '
                f'size="{numbers(half)}" rgba="{colour}"/><geom name="ball_{side}_fin" '
                'class="object" type="box" contype="4" conaffinity="0" mass="0.002" '
                f'size="{numbers((0.004, _FIN_HALF_M, fin_half_z))}" pos="{numbers(fin)}" '
                f'solref="0.006 1" rgba="{colour}"/></body>'
                f'<body name="pin_{side}" '
                f'pos="0 {-inwards * _PIN_Y_M!r} {_CENTRE_Z_M + _PIN_Z_M!r}">'
                f'<joint name="pin_{side}_slide" {slide} frictionloss="{_PIN_FRICTION_N!r}"/>'
                f'<geom name="pin_{side}_block" class="object" type="box" contype="0" '
                f'conaffinity="4" mass="0.01" size="{numbers(_PIN_HALF_M)}" solref="0.006 1" '
                f'rgba="{_COLOURS["pin"]}"/></body>'
            ]
        return "".join(parts) + "</body>"

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "3 7"]:
        """Behind the centre, ±3 cm and ±0.2 rad, the ball round, the pins apart."""
        x, y = generator.uniform(-0.03, 0.03, size=2)
        R = yawed(_TURNED_RAD + float(generator.uniform(-0.2, 0.2)))
        pin_z = _CENTRE_Z_M + _PIN_Z_M
        offsets = np.array(
            [[0.0, 0.0, 0.0], *([0.0, -inwards * _PIN_Y_M, pin_z] for _, inwards in _SIDES)]
        )
        places = np.array([0.01 + x, 0.03 + y, 0.0]) + offsets @ R.T
        return np.concatenate([places, np.tile(quaternion_from_rotation(R), (3, 1))], axis=1)

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Approach from the side, enclose, squeeze slowly, hold, open, withdraw."""
        grip = Grip(_GRASPS[domain], domain, gap_m=_OPEN_M, force_n=_SQUEEZE_N)
        start_m, away_m = draw.uniform(-0.02, 0.02, size=(2, 3))
        T_world_stand = transform_from_pose(poses[0])

        def hand(error: WaypointNoise) -> HandPose:
            """Open hand around the ball, its palm to the left."""
            middle = T_world_stand[:3, 3] + error.offset_m + [0.0, 0.0, _CENTRE_Z_M]
            return grip.around(yawed(error.yaw_rad) @ T_world_stand[:3, :3] @ THUMB_UP, middle)

        aside = T_world_stand[:3, :3] @ np.array([0.13, -0.03, 0.02])
        reach = hand(noise[0])
        # The hand drifts by a part of the second error while it squeezes.
        squeezed = grip.pressed(moved(reach, 0.3 * noise[1].offset_m))
        opened_again = bent(squeezed, grip.open_rad)
        path = [
            (0.0, moved(hand(NO_NOISE), aside + start_m)),
            (0.9, reach),
            (1.9, squeezed),
            (2.7, squeezed),
            (3.3, opened_again),
            (4.6, moved(opened_again, aside + away_m)),
        ]
        return one_handed(path, domain)

    def succeeded(self, simulation: Simulation) -> bool:
        """Both pins pushed in by 4.5 mm, at rest, and neither they nor the ball touched."""
        return _inwards_m(simulation) > _SQUEEZED_M and is_left(simulation)

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Touched by a hand; both pins pushed in by 2 mm; by 4.5 mm; released."""
        inwards_m = _inwards_m(simulation)
        return (
            simulation.hand_touches(0),
            inwards_m > _PRESSED_M,
            inwards_m > _SQUEEZED_M,
            self.succeeded(simulation),
        )
