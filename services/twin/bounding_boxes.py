"""Bounding boxes of a task's objects in their own frames, from the compiled geoms."""

from collections.abc import Callable
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float64

from dextouch.geometry import apply, invert, transform, transform_from_pose
from services.twin.scene import Scene

# Half extent of a solid along each axis of another frame; the rows of `A` are the axes of that
# frame in the solid's own, `size` is MuJoCo's.
_REACH: Final[dict[int, Callable[[np.ndarray, np.ndarray], np.ndarray]]] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda A, size: np.full(3, size[0]),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda A, size: size[0] + size[1] * np.abs(A[:, 2]),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): lambda A, size: np.linalg.norm(A * size, axis=1),
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda A, size: np.abs(A) @ size,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda A, size: (
        size[0] * np.hypot(A[:, 0], A[:, 1]) + size[1] * np.abs(A[:, 2])
    ),
}
_MESH: Final = int(mujoco.mjtGeom.mjGEOM_MESH)


def object_boxes_m(scene: Scene) -> Float64[np.ndarray, "objects 6"]:
    """Centre x y z and half sizes x y z of each object's box in its own frame (m).

    Unnamed parts of an object are included with their joints at rest; meshes by their hull.
    """
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    boxes = np.zeros((len(scene.object_names), 6))
    for index, body in enumerate(scene.bodies.ids.tolist()):
        pose = np.concatenate([data.xpos[body], data.xquat[body]])
        T_object_world = invert(transform_from_pose(pose))
        spans = [
            _span(scene.model, data, geom, T_object_world)
            for geom in np.flatnonzero(scene.geom_object == index).tolist()
        ]
        low = np.min([span[0] for span in spans], axis=0)
        high = np.max([span[1] for span in spans], axis=0)
        boxes[index] = [*(0.5 * (low + high)), *(0.5 * (high - low))]
    return boxes


def _span(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    geom: int,
    T_object_world: Float64[np.ndarray, "4 4"],
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Minimum and maximum coordinates of a geom in its object's frame."""
    R_world_geom = data.geom_xmat[geom].reshape(3, 3)
    T = T_object_world @ transform(R_world_geom, data.geom_xpos[geom])
    kind = int(model.geom_type[geom])
    if kind == _MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        points = apply(T, model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float))
        return points.min(axis=0), points.max(axis=0)
    reach = _REACH[kind](T[:3, :3], model.geom_size[geom])
    return T[:3, 3] - reach, T[:3, 3] + reach
