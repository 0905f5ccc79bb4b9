"""Exact labels and depths of recorded twin episodes, for metrics of predicted images."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from dextouch.episodes import EpisodeReader, object_track
from dextouch.hands.actions import poses_from_actions
from services.evaluation.prediction_scenes import FAR_M, Scene, SceneGeometry
from services.twin.scene_views import SceneViews
from services.twin.settings import TwinSettings
from services.twin.stage import Stage


class TwinGeometry:
    """Rebuilds the state of recorded steps in the twin and casts the head camera's rays."""

    def __init__(self) -> None:
        self._views: dict[tuple[str, tuple[int, ...]], SceneViews] = {}

    def added_to(self, scene: Scene, reader: EpisodeReader) -> Scene:
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
        geometry = SceneGeometry(
            views.colours,
            np.stack([one.labels for one in seen]),
            np.stack([one.depth_m for one in seen]),
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
    rays = stage.rig.rays("camera_head")
    down = -(rays @ T_world_camera[:3, :3].T)[:, 2]
    distance_m = T_world_camera[2, 3] / np.where(down > 1e-6, down, 1e-6)
    return np.minimum(distance_m * rays[:, 2], FAR_M).reshape(stage.rig.shape_px)
