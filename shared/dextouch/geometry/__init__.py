"""Rotations, rigid transforms, interpolation and pinhole cameras in float64."""

from dextouch.geometry.cameras import pinhole_matrix, project
from dextouch.geometry.interpolation import (
    bracket,
    interpolate_linear,
    interpolate_poses,
    nearest_index,
)
from dextouch.geometry.transforms import (
    apply,
    invert,
    pose_from_transform,
    transform,
    transform_from_pose,
)

__all__ = [
    "apply",
    "bracket",
    "interpolate_linear",
    "interpolate_poses",
    "invert",
    "nearest_index",
    "pinhole_matrix",
    "pose_from_transform",
    "project",
    "rotations",
    "transform",
    "transform_from_pose",
]
