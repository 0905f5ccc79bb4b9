"""Poses of a scene's objects as the networks hold them: position and two axes a slot."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, Shaped
from torch import Tensor

from dextouch.geometry.transforms import pose_from_transform, transform, transform_from_pose
from services.world_model.dynamics.configuration import MAX_OBJECTS

# An object farther than this from the world's origin counts as not there.
MAX_DISTANCE_M = 1.0


@dataclass(frozen=True)
class ObjectPoses:
    """Objects in the world frame.

    `axes` are the images of the object's z and x axis. A network that cannot know an axis (the
    yaw of a round bowl) predicts it shorter than one, so lengths carry certainty. `present` is 1
    where there is an object, 0 in unused slots and for objects out of reach; between them it is a
    probability.
    """

    position_m: Float32[Tensor, "*batch objects 3"]
    axes: Float32[Tensor, "*batch objects 2 3"]
    present: Float32[Tensor, "*batch objects"]

    def __getitem__(self, index: Tensor | int | slice | tuple[slice, int]) -> "ObjectPoses":
        """Some entries of the batch."""
        return ObjectPoses(self.position_m[index], self.axes[index], self.present[index])


def objects_from_poses(poses: Shaped[np.ndarray, "*batch objects 7"]) -> ObjectPoses:
    """True poses (x y z in metres, qw qx qy qz) as filled slots; further slots are empty."""
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
    z), any perpendicular direction is taken: the object is round about z as far as anybody knows.
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


def _unit(vectors: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-3, vectors / np.maximum(length, 1e-3), otherwise)
