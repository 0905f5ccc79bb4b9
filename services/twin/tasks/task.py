"""Protocol of tasks: objects and placement, demonstrator script, milestones, success check."""

from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from services.twin.demonstrators import Waypoint, WaypointNoise
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
