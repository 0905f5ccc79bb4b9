"""Constants and motions of a scene by hand: a camera above the table that looks straight down."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dextouch.geometry import pinhole_matrix, transform
from dextouch.geometry.rotations import rotation_from_vector
from services.world_model.rendering.rasters import SceneStates
from services.world_model.rendering.renderer import Drawing, Renderer

# Looks straight down: x of the image is x of the world, y of the image is -y.
DOWN = np.diag([1.0, -1.0, -1.0])
K = pinhole_matrix(width_px=64, height_px=64, fovy_rad=np.deg2rad(46.0))
BOXES_M = np.array([[0.0, 0.0, 0.01, 0.03, 0.02, 0.01], [0.0, 0.0, 0.0, 0.02, 0.02, 0.02]])


@dataclass(frozen=True)
class SceneState:
    """One of `SceneStates`."""

    T_world_camera: np.ndarray
    Ts_world_wrist: np.ndarray
    joints_rad: np.ndarray
    object_poses: np.ndarray
    object_present: np.ndarray


def stacked(*states: SceneState) -> SceneStates:
    names = vars(states[0])
    return SceneStates(*(np.stack([getattr(one, name) for one in states]) for name in names))


def drawing(image, K_head, start: SceneState, states: Sequence[SceneState], boxes_m) -> Drawing:
    return Drawing(image, K_head, stacked(start, *states), boxes_m)


def draw(renderer: Renderer, *given) -> np.ndarray:
    """Images of one rollout, as given to `drawing`."""
    return renderer.draw_all([drawing(*given)])[0]


def shifted(state: SceneState, *, camera_m=(0.0, 0.0, 0.0), objects_m=(0.0, 0.0, 0.0)):
    """The same scene after the camera and the objects moved in the world."""
    T = state.T_world_camera.copy()
    T[:3, 3] += camera_m
    poses = state.object_poses.copy()
    poses[:, :3] += objects_m
    return replace(state, T_world_camera=T, object_poses=poses)


def turned(state: SceneState, vector_rad) -> SceneState:
    """The same scene after the camera turned in its own frame."""
    R = rotation_from_vector(np.asarray(vector_rad, dtype=float))
    return replace(state, T_world_camera=state.T_world_camera @ transform(R, np.zeros(3)))
