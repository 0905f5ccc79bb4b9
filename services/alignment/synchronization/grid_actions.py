"""Hand trajectories and 67-D actions at the steps of the model's grid."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.hands.actions import AnchorPoses, HandTrajectory, actions_from_poses
from dextouch.schemas import Domain, Matrix
from dextouch.tactile.layout import SIDES
from services.alignment.synchronization.hand_joints import retarget_hands
from services.alignment.synchronization.recorded_streams import LoadedStream
from services.alignment.synchronization.resampling import (
    GridPlacement,
    place_on_grid,
    poses_on_grid,
    vectors_on_grid,
)

POSE_STREAMS = ("wrist_left", "wrist_right", "head")
COMMANDED_STREAMS = ("joints_commanded", "wrist_left_commanded", "wrist_right_commanded")
REQUIRED: Mapping[Domain, tuple[str, ...]] = {
    "human": (*POSE_STREAMS, "keypoints_left", "keypoints_right"),
    "robot": (*POSE_STREAMS, "joints_measured"),
}


@dataclass(frozen=True)
class GriddedStreams:
    """Streams that actions are computed from, and the placement of the grid among their samples.

    `valid` marks the steps at which every one of them can be read without reaching across a gap.
    """

    grid_ns: Int64[np.ndarray, " n"]
    streams: Mapping[str, LoadedStream]
    at: Mapping[str, GridPlacement]
    valid: Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class GridActions:
    """Actions on the grid; `commanded` is None where nothing was commanded."""

    anchor: AnchorPoses
    measured: Float64[np.ndarray, "n 67"]
    commanded: Float64[np.ndarray, "n 67"] | None
    quality: dict[str, float]


def place_streams(
    streams: Mapping[str, LoadedStream], grid_ns: np.ndarray, *, max_gap_ns: int
) -> GriddedStreams:
    """Find the neighbouring samples of every step in every stream."""
    at = {
        name: place_on_grid(
            stream.t_ns, grid_ns, period_ns=stream.descriptor.period_ns(), max_gap_ns=max_gap_ns
        )
        for name, stream in streams.items()
    }
    valid = np.ones(len(grid_ns), dtype=bool)
    for placement in at.values():
        valid &= placement.valid
    return GriddedStreams(grid_ns, streams, at, valid)


def make_actions(
    gridded: GriddedStreams, domain: Domain, calibration: Mapping[str, Matrix]
) -> GridActions:
    """Measured and, where recorded, commanded actions, all relative to the measured first step.

    Human hands are retargeted, a robot's joints taken as they are.
    """
    left, right, head = (_poses(gridded, name) for name in POSE_STREAMS)
    if domain == "human":
        joints, quality = retarget_hands(gridded.streams, gridded.at, calibration)
    else:
        joints, quality = _joints(gridded, "joints_measured"), {}
    trajectory = _trajectory((left, right, head), joints)
    anchor = trajectory.anchor(0)
    commanded = None
    if all(name in gridded.streams for name in COMMANDED_STREAMS):
        wrists = [_poses(gridded, f"wrist_{side}_commanded") for side in SIDES]
        # Nobody commands the head: where it was is where it should have been.
        wanted = _trajectory((*wrists, head), _joints(gridded, "joints_commanded"))
        commanded = actions_from_poses(wanted, anchor)
    return GridActions(anchor, actions_from_poses(trajectory, anchor), commanded, quality)


def _trajectory(poses: Sequence[np.ndarray], joints_rad: np.ndarray) -> HandTrajectory:
    """From the poses of left wrist, right wrist and head, and 40 joint angles."""
    left, right, head = poses
    joints_left_rad, joints_right_rad = np.split(joints_rad, 2, axis=1)
    return HandTrajectory(left, right, joints_left_rad, joints_right_rad, head)


def _poses(gridded: GriddedStreams, name: str) -> Float64[np.ndarray, "n 4 4"]:
    return poses_on_grid(gridded.streams[name].values, gridded.at[name])


def _joints(gridded: GriddedStreams, name: str) -> Float64[np.ndarray, "n 40"]:
    return vectors_on_grid(gridded.streams[name].values, gridded.at[name])
