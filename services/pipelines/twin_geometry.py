"""Exact labels and depths of recorded twin episodes, for metrics of predicted images."""

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.episodes import EpisodeReader, object_track
from dextouch.hands.actions import HandTrajectory, poses_from_actions
from services.evaluation import prediction_scenes
from services.twin import cameras
from services.twin.settings import TwinSettings
from services.twin.stage import Stage, command_row

# The bodies are both hands, then the objects.
FIRST_OBJECT: Final = prediction_scenes.FIRST_BODY + 2


class SceneViews:
    """Views of a task's recorded steps through the head camera.

    Labels are 0 for the background, 1 for the table, 2 and 3 for the left and right hand, then the
    objects in the order of the task; `names` has them in this order. `colours` are the rows of
    label, red, green and blue (0 … 1) of everything visible, unshaded.
    """

    def __init__(self, stage: Stage) -> None:
        self.stage, scene = stage, stage.simulation.scene
        self.names = ("background", "table", "left_hand", "right_hand", *scene.object_names)
        labels = np.full(scene.model.ngeom, prediction_scenes.BACKGROUND)
        labels[scene.table_geom] = prediction_scenes.TABLE
        of_hand, of_object = scene.geom_hand >= 0, scene.geom_object >= 0
        labels[of_hand] = prediction_scenes.FIRST_BODY + scene.geom_hand[of_hand]
        labels[of_object] = FIRST_OBJECT + scene.geom_object[of_object]
        self._labels: Int64[np.ndarray, " geoms"] = labels.astype(np.int64)
        rows = np.column_stack([labels, scene.model.geom_rgba[:, :3]])[labels > 0]
        seen = np.vstack([[prediction_scenes.BACKGROUND, *cameras.BACKGROUND], rows])
        self.colours: Float64[np.ndarray, "colours 4"] = np.unique(seen.round(6), axis=0)

    def of(
        self, poses: HandTrajectory, object_poses: Float64[np.ndarray, "steps objects 7"], step: int
    ) -> tuple[Int64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        """Labels and depths (m along the optical axis, infinite for the background) of one step.

        The state is rebuilt without physics, from measured poses and joint angles and from
        T_world_object of every step: x y z (m), qw qx qy qz.
        """
        simulation = self.stage.simulation
        simulation.pose(command_row(poses, step), object_poses[step])
        geoms, depth_m = self.stage.rig.cast(simulation, "camera_head")
        return np.where(geoms >= 0, self._labels[geoms], prediction_scenes.BACKGROUND), depth_m


class TwinGeometry:
    """Rebuilds the state of recorded steps in the twin and casts the head camera's rays."""

    def __init__(self) -> None:
        self._views: dict[tuple[str, tuple[int, ...]], SceneViews] = {}

    def added_to(
        self, scene: prediction_scenes.Scene, reader: EpisodeReader
    ) -> prediction_scenes.Scene:
        """The scene with its geometry; unchanged if its episode is not of the twin."""
        about = reader.attributes
        window = reader.window(0, reader.num_steps, cameras=())
        track = object_track(reader, window.t_ref_ns)
        if about.origin != "twin" or track is None:
            return scene
        poses = poses_from_actions(window.actions, window.anchor)
        objects = track.poses.astype(np.float64)
        views = self._of_task(about.task, scene.truth.images.shape[1:3])
        steps = [scene.first_step + step for step in scene.truth.image_steps]
        seen = [views.of(poses, objects, step) for step in steps]
        table = [_table_m(views.stage, poses.Ts_world_camera_head[step]) for step in steps]
        geometry = prediction_scenes.SceneGeometry(
            views.colours,
            np.stack([labels for labels, _ in seen]),
            np.stack([depth_m for _, depth_m in seen]),
            np.stack(table),
        )
        return replace(scene, geometry=geometry)

    def _of_task(self, task: str, shape_px: tuple[int, ...]) -> SceneViews:
        if (task, shape_px) not in self._views:
            height_px, width_px = shape_px
            settings = TwinSettings(image_height_px=height_px, image_width_px=width_px)
            self._views[task, shape_px] = SceneViews(Stage(task, "robot", settings))
        return self._views[task, shape_px]


def _table_m(stage: Stage, T_world_camera: np.ndarray) -> Float64[np.ndarray, "h w"]:
    """Depth of the table's plane z = 0 at every pixel; far where a ray does not meet it."""
    rays = stage.rig.rays["camera_head"]
    down = -(rays @ T_world_camera[:3, :3].T)[:, 2]
    distance_m = T_world_camera[2, 3] / np.where(down > 1e-6, down, 1e-6)
    return np.minimum(distance_m * rays[:, 2], prediction_scenes.FAR_M).reshape(stage.rig.shape_px)
