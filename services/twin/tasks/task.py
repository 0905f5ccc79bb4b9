"""Protocol of tasks: objects and placement, demonstrator script, milestones, success check."""

from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.tactile.layout import Side
from services.twin.demonstrators import HandPose, Waypoint, WaypointNoise
from services.twin.hands import twin_hand
from services.twin.names import Domain
from services.twin.simulation import Simulation

# An object slower than this (m/s and rad/s) is at rest.
REST_SPEED: Final = 0.05


@runtime_checkable
class Task(Protocol):
    """A manipulation task on the table."""

    @property
    def name(self) -> str:
        """Identifier, snake case."""
        ...

    @property
    def instruction(self) -> str:
        """Instruction for an operator or a policy."""
        ...

    @property
    def object_names(self) -> tuple[str, ...]:
        """Bodies of the task, in the order of poses."""
        ...

    @property
    def milestones(self) -> tuple[str, ...]:
        """Milestones in order, snake case; the last one is success."""
        ...

    def objects_mjcf(self) -> str:
        """MJCF of the bodies, with geoms of class `object`.

        Each has a free joint, or is a fixed `mocap="true"` body, or is attached to one by hinges or
        slides; see `services.twin.object_bodies`.
        """
        ...

    def place(self, generator: np.random.Generator) -> Float64[np.ndarray, "objects 7"]:
        """T_world_object at the start, joints at rest: x y z (m), qw qx qy qz."""
        ...

    def script(
        self,
        object_poses: Float64[np.ndarray, "objects 7"],
        *,
        domain: Domain,
        generator: np.random.Generator,
        noise: tuple[WaypointNoise, WaypointNoise],
    ) -> list[Waypoint]:
        """Waypoints of the demonstrator.

        Args:
            object_poses: poses assumed by the demonstrator.
            domain: robot or human hands.
            generator: source of variations between takes that are independent of `noise`.
            noise: errors at the first (grasp) and second (place) location. The first waypoint has
                none.
        """
        ...

    def succeeded(self, simulation: Simulation) -> bool:
        """Whether the task is done now: objects in pose and at rest.

        No hand touches them, unless the task is to hold them.
        """
        ...

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Whether the condition of each milestone holds now; the last one is `succeeded`.

        Contacts of the simulation must be current, as at every grid step.
        """
        ...


# Hand orientations and postures shared by several tasks.

# R_world_wrist with fingers forward (world +y) and the palm down, for the right and left hand.
PALM_DOWN: Final = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
PALM_DOWN_LEFT: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Thumbs up, fingers forward: the right palm faces world -x, the left one +x.
THUMB_UP: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


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
