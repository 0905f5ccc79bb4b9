"""Times at which a task's milestones are first reached in a take."""

from services.twin.simulation import MODEL_RATE_HZ, Simulation
from services.twin.tasks import Task


class EventTimes:
    """Collects the first time of each milestone; those never reached are absent."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self.times_s: dict[str, float] = {}

    def sample(self, step: int, simulation: Simulation) -> None:
        """Record the milestones reached at a grid step, counted from the start of the take."""
        reached = self._task.reached(simulation)
        for name, holds in zip(self._task.milestones, reached, strict=True):
            if holds:
                self.times_s.setdefault(name, step / MODEL_RATE_HZ)
