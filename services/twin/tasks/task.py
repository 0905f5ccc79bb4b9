"""Protocol of tasks: objects and placement, demonstrator script, milestones, success check."""

from collections.abc import Iterable, Sequence
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.tactile.layout import Side
from services.twin.demonstrators import HandPose, Waypoint, WaypointNoise, bent
from services.twin.grasps import CylinderGrasp, opened, pressing
from services.twin.hands import twin_hand
from services.twin.names import Domain
from services.twin.simulation import Simulation

# An object slower than this (m/s and rad/s) is at rest.
REST_SPEED: Final = 0.05
# Hands with the sign of the x axis on their side.
SIGNS: Final[tuple[tuple[Side, float], ...]] = (("left", -1.0), ("right", 1.0))
# R_world_wrist with fingers forward (world +y) and the palm down, for the right and left hand.
PALM_DOWN: Final = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
PALM_DOWN_LEFT: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Thumbs up, fingers forward: the right palm faces world -x, the left one +x.
THUMB_UP: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
Poses = Float64[np.ndarray, "objects 7"]
Draw = np.random.Generator
Noise = tuple[WaypointNoise, WaypointNoise]


@runtime_checkable
class Task(Protocol):
    """A manipulation task on the table."""

    @property
    def name(self) -> str:
        """Identifier, snake case."""

    @property
    def instruction(self) -> str:
        """Instruction for an operator or a policy."""

    @property
    def object_names(self) -> tuple[str, ...]:
        """Bodies of the task, in the order of poses."""

    @property
    def milestones(self) -> tuple[str, ...]:
        """Milestones in order, snake case; the last one is success."""

    def objects_mjcf(self) -> str:
        """MJCF of the bodies, as `services.twin.scene` describes, with geoms of class `object`."""

    def place(self, generator: Draw) -> Poses:
        """T_world_object at the start, joints at rest: x y z (m), qw qx qy qz."""

    def script(self, poses: Poses, domain: Domain, draw: Draw, noise: Noise) -> list[Waypoint]:
        """Waypoints of the demonstrator, who assumes these poses of the objects.

        `draw` is the source of variations between takes that are independent of `noise`, the errors
        at the first (grasp) and second (place) location. The first waypoint has none.
        """

    def succeeded(self, simulation: Simulation) -> bool:
        """Whether objects are in pose, at rest and, unless they are to be held, untouched."""

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Whether each milestone's condition holds at a grid step; the last is `succeeded`."""


def yawed(yaw_rad: float) -> Float64[np.ndarray, "3 3"]:
    """Rotation about the world's z axis."""
    return rotation_from_vector(np.array([0.0, 0.0, yaw_rad]))


def flat(domain: Domain) -> Float64[np.ndarray, "20"]:
    """A straight hand with the thumb raised away from the palm."""
    joints = np.zeros((5, 4))
    joints[1:, 0] = -0.12
    joints[0] = [-1.0, 0.2, 0.0, 0.0]
    hand = twin_hand("right", domain)
    return np.clip(joints.ravel(), hand.kinematics.lower_rad, hand.kinematics.upper_rad)


def relaxed(side: Side, domain: Domain) -> HandPose:
    """A half-open hand resting above its side of the table, out of the way."""
    joints = np.tile(np.array([0.25, 0.0, 0.40, 0.25]), 5)
    joints[:4] = [0.2, -0.4, 0.3, 0.3]
    x = -0.26 if side == "left" else 0.26
    R = PALM_DOWN_LEFT if side == "left" else PALM_DOWN
    hand = twin_hand(side, domain)
    clipped = np.clip(joints, hand.kinematics.lower_rad, hand.kinematics.upper_rad)
    return HandPose(transform(R, np.array([x, -0.16, 0.13])), clipped)


def one_handed(path: Iterable[tuple[float, HandPose]], domain: Domain) -> list[Waypoint]:
    """Waypoints of a right hand at times (s), while the left one rests."""
    rest = relaxed("left", domain)
    return [Waypoint(time_s, rest, pose) for time_s, pose in path]


def with_palm(side: Side, domain: Domain, R: np.ndarray, palm_m: np.ndarray) -> HandPose:
    """A flat hand, turned by R_world_wrist, with the centre of its palm at a point."""
    wrist_m = palm_m - R @ twin_hand(side, domain).palm_centre_m
    return HandPose(transform(R, wrist_m), flat(domain))


class Grip:
    """A hand around a cylinder: open by `gap_m`, and the targets that press it with `force_n`."""

    def __init__(
        self, grasp: CylinderGrasp, domain: Domain, *, gap_m: float, force_n: float
    ) -> None:
        self.open_rad = opened(grasp, domain, gap_m=gap_m)
        self.press_rad = pressing(grasp, domain, force_n=force_n)
        self._grasp, self._domain, self._R_wrist_axis = grasp, domain, grasp.axis_rotation()

    def around(
        self,
        R: Float64[np.ndarray, "3 3"],
        point_m: np.ndarray,
        *,
        side: Side = "right",
        held_m: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> HandPose:
        """The open hand at a cylinder, whose axis is x of R_world_axis.

        What is at the point in the world is `held_m` in the frame of the cylinder.
        """
        R_world_wrist = R @ self._R_wrist_axis.T
        middle_m = self._grasp.axis_point_m(twin_hand(side, self._domain))
        held = middle_m + self._R_wrist_axis @ held_m
        return HandPose(transform(R_world_wrist, point_m - R_world_wrist @ held), self.open_rad)

    def at(self, point_m: np.ndarray, error: WaypointNoise) -> HandPose:
        """The open right hand, thumb up, around an upright cylinder, off by an error."""
        return self.around(yawed(error.yaw_rad) @ THUMB_UP, point_m + error.offset_m)

    def pressed(self, hand: HandPose) -> HandPose:
        """A hand that presses."""
        return bent(hand, self.press_rad)


def at_rest(simulation: Simulation, index: int | slice = slice(None)) -> bool:
    """Whether objects, all or one, are at rest."""
    return bool(np.max(simulation.object_speeds()[index]) < REST_SPEED)


def is_left(simulation: Simulation, index: int | slice = slice(None)) -> bool:
    """Whether objects are at rest, all or one, and no hand touches any."""
    return at_rest(simulation, index) and not simulation.hand_touches()
