"""Sizes of objects: their bounding boxes, and other sizes for a take of what hands can carry."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
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
# Ranges of the factors: a hand still gets around the objects, and they do not tip by themselves.
_LEAST, _MOST = 0.5, 1.5
# Of objects of other sizes: those of a data set differ about this much from the usual ones.
_DRAWN: Final = {"width": (0.75, 1.30), "height": (0.90, 1.10)}
# Fields of a model that depend on the size of a geom.
_GEOMETRY: Final = ("geom_size", "geom_pos", "geom_rbound", "geom_aabb", "bvh_aabb")
_ROUND: Final = {int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}


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


@dataclass(frozen=True)
class Sizes:
    """Factors of the usual size of all objects that hands can carry, in the objects' frames.

    `width` is along x and y and `height` along z, the axis of round objects. Masses stay, and fixed
    objects keep their size.
    """

    width: float = 1.0
    height: float = 1.0

    def __post_init__(self) -> None:
        if not (_LEAST <= self.width <= _MOST and _LEAST <= self.height <= _MOST):
            raise InvalidInputError(
                f"twin: got objects of {self.width} times the usual width and {self.height} times "
                f"the usual height, expected {_LEAST} … {_MOST}"
            )

    @classmethod
    def drawn(cls, generator: np.random.Generator) -> "Sizes":
        """Other sizes for a take of a training set."""
        width, height = (round(float(generator.uniform(*_DRAWN[name])), 3) for name in _DRAWN)
        return cls(width, height)

    @property
    def factors(self) -> Float64[np.ndarray, "3"]:
        """Factors along x, y and z."""
        return np.array([self.width, self.width, self.height])

    @property
    def labels(self) -> list[str]:
        """Parts of an episode's id; none for the usual sizes."""
        if self == USUAL:
            return []
        return [f"w{round(1000 * self.width)}h{round(1000 * self.height)}"]


USUAL: Final = Sizes()


class Geometry:
    """The usual geometry of a scene's objects, and changes of it."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._usual = {name: np.array(getattr(scene.model, name)) for name in _GEOMETRY}
        free = np.flatnonzero(scene.bodies.is_free)
        self._geoms = np.flatnonzero(np.isin(scene.geom_object, free))
        self._bodies = np.flatnonzero(np.isin(scene.bodies.of_body, free))

    def resize(self, sizes: Sizes) -> None:
        """Give objects their sizes of a take, from the usual ones.

        Geoms that are turned in their object grow along each of their own axes as the object does
        along it.
        """
        model = self._scene.model
        for name, values in self._usual.items():
            getattr(model, name)[:] = values
        if sizes == USUAL:
            return
        for geom in self._geoms.tolist():
            pose = np.concatenate([model.geom_pos[geom], model.geom_quat[geom]])
            R = transform_from_pose(pose)[:3, :3]
            along = np.linalg.norm(sizes.factors[:, None] * R, axis=0)
            size = along.copy()
            if int(model.geom_type[geom]) in _ROUND:
                size = np.array([along[:2].mean(), along[2], 1.0])
            model.geom_size[geom] *= size
            model.geom_pos[geom] *= sizes.factors
            model.geom_aabb[geom] *= np.tile(along, 2)
            model.geom_rbound[geom] *= along.max()
        for body in self._bodies.tolist():
            first = model.body_bvhadr[body]
            # Boxes that collisions are searched in: larger ones find the same contacts.
            model.bvh_aabb[first : first + model.body_bvhnum[body], 3:] *= 2 * _MOST

    def on_the_same_level(
        self, poses: Float64[np.ndarray, "objects 7"], sizes: Sizes, boxes_m: np.ndarray
    ) -> Float64[np.ndarray, "objects 7"]:
        """Poses with the lowest point of every resized object where it was before.

        Poses are planned for the usual sizes; `boxes_m` are middle and half sizes of the usual
        boxes in the objects' frames.
        """
        placed = np.array(poses)
        up = transform_from_pose(placed)[:, 2, :3]
        low_m = [
            (up * boxes_m[:, :3] * factors).sum(1) - (np.abs(up) * boxes_m[:, 3:] * factors).sum(1)
            for factors in (np.ones(3), sizes.factors)
        ]
        placed[:, 2] += np.where(self._scene.bodies.is_free, low_m[0] - low_m[1], 0.0)
        return placed
