"""What each pixel of a recorded step shows, and how far away: exact labels and depths of the twin.

The state of a step is rebuilt from the poses and joint angles of its episode, without physics.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.hands.actions import HandTrajectory
from services.twin.object_bodies import BACKGROUND
from services.twin.stage import Stage, command_row

BACKGROUND_LABEL: Final = 0
TABLE_LABEL: Final = 1
LEFT_HAND_LABEL: Final = 2
FIRST_OBJECT_LABEL: Final = 4


@dataclass(frozen=True)
class View:
    """Labels and depths (m along the optical axis, infinite for the background) of an image."""

    labels: Int64[np.ndarray, "h w"]
    depth_m: Float64[np.ndarray, "h w"]


class SceneViews:
    """Views of a task's recorded steps through the head camera.

    Labels are 0 for the background, 1 for the table, 2 and 3 for the left and right hand, then the
    objects in the order of the task; `names` has them in this order. `colours` are the rows of
    label, red, green and blue (0 … 1) of everything visible, unshaded.
    """

    def __init__(self, stage: Stage) -> None:
        self.stage, scene = stage, stage.simulation.scene
        self.names = ("background", "table", "left_hand", "right_hand", *scene.object_names)
        labels = np.full(scene.model.ngeom, BACKGROUND_LABEL)
        labels[scene.table_geom] = TABLE_LABEL
        of_hand, of_object = scene.geom_hand >= 0, scene.geom_object >= 0
        labels[of_hand] = LEFT_HAND_LABEL + scene.geom_hand[of_hand]
        labels[of_object] = FIRST_OBJECT_LABEL + scene.geom_object[of_object]
        self._labels: Int64[np.ndarray, " geoms"] = labels.astype(np.int64)
        rows = np.column_stack([labels, scene.model.geom_rgba[:, :3]])[labels > 0]
        seen = np.vstack([[BACKGROUND_LABEL, *BACKGROUND], rows])
        self.colours: Float64[np.ndarray, "colours 4"] = np.unique(seen.round(6), axis=0)

    def of(
        self,
        poses: HandTrajectory,
        object_poses: Float64[np.ndarray, "steps objects 7"],
        step: int,
    ) -> View:
        """Labels and depths of one step.

        Args:
            poses: measured poses of hands and head camera, and joint angles.
            object_poses: T_world_object of every step: x y z (m), qw qx qy qz.
            step: row of both.
        """
        simulation = self.stage.simulation
        simulation.pose(command_row(poses, step), object_poses[step])
        geoms, depth_m = self.stage.rig.cast(simulation, "camera_head")
        labels = np.where(geoms >= 0, self._labels[geoms], BACKGROUND_LABEL)
        return View(labels, depth_m)
