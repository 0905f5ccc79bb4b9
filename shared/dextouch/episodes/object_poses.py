"""Poses of an episode's objects at given times, from whichever streams the episode has of them."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from dextouch.episodes.reader import EpisodeReader
from dextouch.geometry import (
    bracket,
    interpolate_poses,
    pose_from_transform,
    transform_from_pose,
)
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import object_stream
from dextouch.streams import HEAD_CAMERA

# Ground truth, and what imagined worlds say: all objects in one stream, without gaps.
OBJECT_POSES: Final = "object_poses"
# Which camera sees markers, and is clicked in.
# Where the pose of an object is from; "none" of one that is known nowhere.
ObjectSource = Literal["twin", "markers", "tracker", "clicks", "none"]
# Between two sightings that are at most so far apart, an object is taken to have moved evenly ...
_MAX_GAP_NS: Final = 250_000_000
# ... and to have stood still between two that are this close to one another, however far apart.
_STOOD_M, _STOOD_RAD = 0.015, np.deg2rad(10.0)
# Periods of a stream beyond its first and last sample.
_EDGE_PERIODS: Final = 1.5


@dataclass(frozen=True)
class ObjectTrack:
    """Poses T_world_object (x y z m, qw qx qy qz) of objects, and at which steps they are known.

    Where a pose is not known it is the last one before, or the first one after. `sources` say where
    each object's poses are from: those that are not from the twin have the errors of a measurement,
    a few millimetres. `clicked_sd_m` is the standard deviation of a clicked position on each axis
    of the table, 0 of other sources.
    """

    poses: Float32[np.ndarray, "steps objects 7"]
    known: Bool[np.ndarray, "steps objects"]
    sources: tuple[ObjectSource, ...]
    clicked_sd_m: Float32[np.ndarray, " objects"]

    @property
    def is_measured(self) -> bool:
        """Whether poses have the errors of a measurement."""
        return bool(set(self.sources) - {"twin"})

    @classmethod
    def unknown(cls, num_steps: int, num_objects: int) -> "ObjectTrack":
        """Objects of which nothing is known."""
        poses = np.zeros((num_steps, num_objects, 7), dtype=np.float32)
        poses[..., 3] = 1.0
        known = np.zeros((num_steps, num_objects), dtype=np.bool_)
        return cls.of_one_source("none", poses, known)

    @classmethod
    def of_one_source(
        cls, source: ObjectSource, poses: np.ndarray, known: np.ndarray
    ) -> "ObjectTrack":
        """Objects whose poses are all from one source, which is not clicks."""
        count = poses.shape[1]
        return cls(poses, known, (source,) * count, np.zeros(count, dtype=np.float32))


def object_track(
    reader: EpisodeReader, t_ref_ns: Int64[np.ndarray, " steps"]
) -> ObjectTrack | None:
    """Poses of an episode's objects at given times, in the order of its `object_names`.

    They come from the stream `object_poses` or else from the streams `object_NAME`, which have
    samples only where the object was seen.

    Returns:
        None if the episode has neither.

    Raises:
        CorruptDataError: damaged bytes.
    """
    if OBJECT_POSES in reader.streams:
        return ObjectTrack.of_one_source("twin", *_all_at_once(reader, t_ref_ns))
    names = reader.attributes.object_names
    if not any(object_stream(name) in reader.streams for name in names):
        return None
    each = [_one(reader, object_stream(name), t_ref_ns) for name in names]
    poses = np.stack([one[0] for one in each], axis=1).astype(np.float32)
    known = np.stack([one[1] for one in each], axis=1)
    sources = tuple(
        _measured_by(reader, name) if known[:, index].any() else "none"
        for index, name in enumerate(names)
    )
    return ObjectTrack(poses, known, sources, np.zeros(len(names), dtype=np.float32))


def _measured_by(reader: EpisodeReader, name: str) -> ObjectSource:
    return "markers" if reader.streams[object_stream(name)].device == HEAD_CAMERA else "tracker"


def has_object_poses(reader: EpisodeReader) -> bool:
    """Whether an episode has poses of its objects."""
    names = [object_stream(name) for name in reader.attributes.object_names]
    return any(name in reader.streams for name in (OBJECT_POSES, *names))


def _all_at_once(
    reader: EpisodeReader, t_ref_ns: np.ndarray
) -> tuple[Float32[np.ndarray, "steps objects 7"], Bool[np.ndarray, "steps objects"]]:
    data = reader.read(OBJECT_POSES)
    places = np.searchsorted(data.t_ref_ns, t_ref_ns).clip(0, len(data) - 1)
    if len(data) == 1 or np.array_equal(data.t_ref_ns[places], t_ref_ns):
        poses = data.values[places].astype(np.float32)
    else:
        left, weight, _ = bracket(data.t_ref_ns, t_ref_ns, max_gap_ns=_MAX_GAP_NS)
        Ts = transform_from_pose(data.values)
        each = [interpolate_poses(Ts[:, index], left, weight) for index in range(Ts.shape[1])]
        poses = pose_from_transform(np.stack(each, axis=1)).astype(np.float32)
    return poses, np.ones(poses.shape[:2], dtype=np.bool_)


def _one(
    reader: EpisodeReader, name: str, t_ref_ns: np.ndarray
) -> tuple[Float64[np.ndarray, "steps 7"], Bool[np.ndarray, " steps"]]:
    """Poses of one object, and where they are known."""
    data = reader.read(name) if name in reader.streams else None
    if data is None or len(data) < 2:
        nowhere = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(t_ref_ns), 1))
        return nowhere, np.zeros(len(t_ref_ns), dtype=np.bool_)
    t_ns, Ts = data.t_ref_ns, transform_from_pose(data.values)
    way_m = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1)
    turned_rad = rotation_angle(np.swapaxes(Ts[:-1, :3, :3], -1, -2) @ Ts[1:, :3, :3])
    joined = np.diff(t_ns) <= _MAX_GAP_NS
    joined |= (way_m <= _STOOD_M) & (turned_rad <= _STOOD_RAD)
    left, weight, _ = bracket(t_ns, t_ref_ns, max_gap_ns=_MAX_GAP_NS)
    edge_ns = _EDGE_PERIODS * reader.streams[name].period_ns()
    inside = (t_ref_ns >= t_ns[0] - edge_ns) & (t_ref_ns <= t_ns[-1] + edge_ns)
    known = inside & (joined[left] | (weight == 0.0) | (weight == 1.0))
    held = np.where(joined[left] | (weight == 1.0), weight, 0.0)
    return pose_from_transform(interpolate_poses(Ts, left, held)), known
