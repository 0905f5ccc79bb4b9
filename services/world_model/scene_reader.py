"""Objects of an observed or imagined step, as the start readers of a state model see them."""

from collections.abc import Sequence

import numpy as np
import torch

from dextouch.errors import UnknownNameError
from services.world_model.dynamics.hand_motion import hand_motion
from services.world_model.dynamics.model import first_steps, mean_poses
from services.world_model.dynamics.nested import stacked
from services.world_model.dynamics.objects import BOX_AXES, poses_from_objects
from services.world_model.network.contact_geometry import ObjectsAtStart
from services.world_model.network.inputs import PredictionRequest
from services.world_model.state_checkpoints import StateCheckpoint


class SceneReader:
    """Finds the objects of requests, for a model that is conditioned on contact geometry.

    Args:
        checkpoint: a state model, whose start readers are averaged.
    """

    def __init__(self, checkpoint: StateCheckpoint) -> None:
        self._readers = checkpoint.dynamics.readers()
        self._metadata = checkpoint.metadata
        self.tasks = checkpoint.metadata.dynamics.tasks

    @torch.no_grad()
    def objects(
        self, requests: Sequence[PredictionRequest], tasks: Sequence[str]
    ) -> list[ObjectsAtStart]:
        """Objects at the first step of every request.

        Raises:
            UnknownNameError: a task that the state model was not trained on.
        """
        unknown = sorted(set(tasks) - set(self.tasks))
        if unknown:
            raise UnknownNameError("task of the start readers", unknown[0], list(self.tasks))
        hands = [hand_motion(request.actions[:1], request.anchor) for request in requests]
        first = first_steps(
            [request.first_image for request in requests],
            [request.K_head for request in requests],
            [request.first_tactile_kpa for request in requests],
            hands,
            [self.tasks.index(task) for task in tasks],
        )
        readings = [reader(first) for reader in self._readers]
        poses = poses_from_objects(mean_poses(stacked([one.objects for one in readings])))
        size = stacked([one.size for one in readings]).mean(0).double().numpy()
        return [
            self._seen(task, *each)
            for task, each in zip(tasks, zip(poses, size, strict=True), strict=True)
        ]

    def _seen(self, task: str, poses: np.ndarray, size: np.ndarray) -> ObjectsAtStart:
        boxes_m = np.array(self._metadata.object_boxes_m[task])
        count = len(boxes_m)
        return ObjectsAtStart(poses[:count], boxes_m * size[:count, BOX_AXES])
