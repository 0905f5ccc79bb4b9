"""Object poses of a scene as network tensors: a position and two axes per slot."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, Shaped
from torch import Tensor
from torch.nn import functional

from dextouch.geometry import pose_from_transform, transform, transform_from_pose
from dextouch.schemas import MAX_OBJECTS

# Objects farther than this from the world's origin count as absent.
MAX_DISTANCE_M = 1.0
# Factors of the usual size that an object may have.
SIZE_RANGE = (0.5, 2.0)
# Which factor, width or height, each number of a box has: middle, half sizes; x, y, z.
BOX_AXES = [0, 0, 1, 0, 0, 1]
# Shorter axes have no direction.
_SHORTEST = 1e-3


@dataclass(frozen=True)
class ObjectPoses:
    """Objects in the world frame.

    `axes` are the directions of the object's z and x axis. An axis that cannot be observed (the yaw
    of a round bowl) is predicted shorter than one, so that its length expresses certainty.
    `present` is 1 for an object, 0 for unused slots and objects out of reach, and a probability in
    between.
    """

    position_m: Float32[Tensor, "*batch objects 3"]
    axes: Float32[Tensor, "*batch objects 2 3"]
    present: Float32[Tensor, "*batch objects"]

    def __getitem__(self, index: Tensor | int | slice | tuple[slice, int]) -> "ObjectPoses":
        """Index the batch."""
        return ObjectPoses(self.position_m[index], self.axes[index], self.present[index])

    def slots(self, count: int) -> "ObjectPoses":
        """The first slots."""
        return ObjectPoses(
            self.position_m[..., :count, :],
            self.axes[..., :count, :, :],
            self.present[..., :count],
        )


def objects_from_poses(poses: Shaped[np.ndarray, "*batch objects 7"]) -> ObjectPoses:
    """Fill slots with known poses (x y z in metres, qw qx qy qz); further slots stay empty."""
    T = transform_from_pose(np.asarray(poses, dtype=np.float64))
    batch, count = T.shape[:-3], T.shape[-3]
    position = np.zeros((*batch, MAX_OBJECTS, 3), dtype=np.float32)
    axes = np.zeros((*batch, MAX_OBJECTS, 2, 3), dtype=np.float32)
    present = np.zeros((*batch, MAX_OBJECTS), dtype=np.float32)
    near = np.linalg.norm(T[..., :3, 3], axis=-1) <= MAX_DISTANCE_M
    position[..., :count, :] = np.where(near[..., None], T[..., :3, 3], 0.0)
    axes[..., :count, 0, :], axes[..., :count, 1, :] = T[..., :3, 2], T[..., :3, 0]
    present[..., :count] = near
    return ObjectPoses(
        torch.from_numpy(position), torch.from_numpy(axes), torch.from_numpy(present)
    )


def poses_from_objects(objects: ObjectPoses) -> Float64[np.ndarray, "*batch objects 7"]:
    """Rigid poses nearest to predicted positions and axes.

    z keeps its direction; x is made perpendicular to it. Where x is unknown (near zero or along
    z), any perpendicular direction is taken, as for an object that is symmetric about z.
    """
    axes = objects.axes.double().numpy()
    z = _unit(axes[..., 0, :], np.array([0.0, 0.0, 1.0]))
    x = axes[..., 1, :] - z * (axes[..., 1, :] * z).sum(-1, keepdims=True)
    helper = np.where(np.abs(z[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    fallback = helper - z * (helper * z).sum(-1, keepdims=True)
    fallback /= np.linalg.norm(fallback, axis=-1, keepdims=True)
    x = _unit(x, fallback)
    R = np.stack([x, np.cross(z, x), z], axis=-1)
    return pose_from_transform(transform(R, objects.position_m.double().numpy()))


def rotations(axes: Float32[Tensor, "*batch 2 3"]) -> Float32[Tensor, "*batch 3 3"]:
    """R_world_object nearest to predicted axes: z keeps its direction, x is made perpendicular.

    As `poses_from_objects`, for networks. Axes of no length give some rotation.
    """
    z = _direction(axes[..., 0, :], torch.tensor([0.0, 0.0, 1.0]))
    x = axes[..., 1, :]
    x = x - z * (x * z).sum(-1, keepdim=True)
    helper = torch.where(
        z[..., :1].abs() < 0.9, torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    )
    x = _direction(x, functional.normalize(helper - z * (helper * z).sum(-1, keepdim=True), dim=-1))
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def _direction(vectors: Tensor, otherwise: Tensor) -> Tensor:
    length = vectors.norm(dim=-1, keepdim=True)
    return torch.where(length > _SHORTEST, vectors / length.clamp_min(_SHORTEST), otherwise)


def _unit(vectors: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > _SHORTEST, vectors / np.maximum(length, _SHORTEST), otherwise)
