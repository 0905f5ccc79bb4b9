"""What every task offers: objects and their places in, waypoints and a verdict out."""

from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from services.twin.demonstrators import Waypoint, WaypointNoise
from services.twin.hands import Domain
from services.twin.simulation import Simulation

# An object that moves slower than this (m/s and rad/s) is at rest.
REST_SPEED: Final = 0.05


@runtime_checkable
class Task(Protocol):
    """One thing to do on the table."""

    @property
    def name(self) -> str:
        """Identifier, snake case."""
        ...

    @property
    def instruction(self) -> str:
        """What an operator or a policy is told."""
        ...

    @property
    def object_names(self) -> tuple[str, ...]:
        """Bodies of the task, in the order of poses."""
        ...

    @property
    def milestones(self) -> tuple[str, ...]:
        """What happens on the way to success, in order, snake case; the last one is success."""
        ...

    def objects_mjcf(self) -> str:
        """The bodies with geoms of class `object`.

        Each has a free joint, or is a `mocap="true"` body (a thing that stands fixed), or hangs
        on one by hinges or slides; see `services.twin.object_bodies`.
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
        """How the demonstrator does it.

        Args:
            object_poses: where the demonstrator believes the objects are.
            domain: whose hands.
            generator: of the habits that vary between takes but do not depend on `noise`.
            noise: errors at the first (grasp) and second (place) location. The first waypoint is
                free of them.
        """
        ...

    def succeeded(self, simulation: Simulation) -> bool:
        """Whether the task is done now: objects in pose, at rest, and no hand touching them."""
        ...

    def reached(self, simulation: Simulation) -> tuple[bool, ...]:
        """Whether the condition of each milestone holds now; the last one is `succeeded`.

        Simulation must be at a step where contacts are current, such as every grid step.
        """
        ...
