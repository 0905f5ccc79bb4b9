"""Poses of an episode's objects: from its streams at any time, and clicks at its first step."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from dextouch.episodes.reader import EpisodeReader
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry import (
    Distortion,
    bracket,
    interpolate_poses,
    points_on_level,
    pose_from_transform,
    transform,
    transform_from_pose,
)
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import (
    EpisodeAttributes,
    EpisodeClicks,
    SceneObject,
    SceneObjects,
    object_stream,
)
from dextouch.streams import HEAD_CAMERA

# Ground truth, and what imagined worlds say: all objects in one stream, without gaps.
OBJECT_POSES: Final = "object_poses"
# Where the pose of an object is from; "none" of one that is known nowhere.
ObjectSource = Literal["twin", "markers", "tracker", "clicks", "touch", "none"]
# Between two sightings that are at most so far apart, an object is taken to have moved evenly ...
_MAX_GAP_NS: Final = 250_000_000
# ... and to have stood still between two that are this close to one another, however far apart.
_STOOD_M, _STOOD_RAD = 0.015, np.deg2rad(10.0)
# Periods of a stream beyond its first and last sample.
_EDGE_PERIODS: Final = 1.5
Pixel = tuple[float, float]
# Of people's clicks, on each axis of the image.
CLICK_SD_PX: Final = 3.0
# Second clicks that are nearer to the first say nothing of a heading.
LEAST_HEADING_M: Final = 0.01
# Objects farther than this from the world's origin count as absent in world models.
_REACH_M: Final = 1.0
_ABSENT_POSE: Final = np.array([0.0, 0.0, -2.0 * _REACH_M, 1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class ObjectTrack:
    """Poses T_world_object (x y z m, qw qx qy qz) of objects, and at which steps they are known.

    Where a pose is not known it is the last one before, or the first one after. `sources` say where
    each object's poses are from: those that are not from the twin have the errors of a measurement,
    a few millimetres. `sd_m` is the standard deviation of a position from clicks or touch on each
    axis of the table, 0 of other sources.
    """

    poses: Float32[np.ndarray, "steps objects 7"]
    known: Bool[np.ndarray, "steps objects"]
    sources: tuple[ObjectSource, ...]
    sd_m: Float32[np.ndarray, " objects"]

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
        """Objects whose poses are all from one source, other than clicks and touch."""
        count = poses.shape[1]
        return cls(poses, known, (source,) * count, np.zeros(count, dtype=np.float32))

    def filled(self, other: "ObjectTrack") -> "ObjectTrack":
        """This track, with the objects of another where this one knows none of their poses."""
        chosen = np.logical_and(other.known.any(axis=0), ~self.known.any(axis=0))
        each = zip(chosen.tolist(), self.sources, other.sources, strict=True)
        return ObjectTrack(
            np.where(chosen[:, None], other.poses, self.poses),
            np.where(chosen, other.known, self.known),
            tuple(theirs if is_chosen else own for is_chosen, own, theirs in each),
            np.where(chosen, other.sd_m, self.sd_m),
        )


def object_track(
    reader: EpisodeReader, t_ref_ns: Int64[np.ndarray, " steps"]
) -> ObjectTrack | None:
    """Poses of an episode's objects at given times, in the order of its `object_names`.

    They come from the stream `object_poses` or else from the streams `object_NAME`, which have
    samples only where the object was seen; None if the episode has neither.

    Raises CorruptDataError for damaged bytes.
    """
    if OBJECT_POSES in reader.streams:
        return ObjectTrack.of_one_source("twin", *_all_at_once(reader, t_ref_ns))
    names = reader.attributes.object_names
    if not any(object_stream(name) in reader.streams for name in names):
        return None
    each = [_one(reader, object_stream(name), t_ref_ns) for name in names]
    poses = np.stack([one[0] for one in each], axis=1).astype(np.float32)
    known = np.stack([one[1] for one in each], axis=1)
    sources: list[ObjectSource] = ["none"] * len(names)
    for index in np.flatnonzero(known.any(axis=0)).tolist():
        by_camera = reader.streams[object_stream(names[index])].device == HEAD_CAMERA
        sources[index] = "markers" if by_camera else "tracker"
    return ObjectTrack(poses, known, tuple(sources), np.zeros(len(names), dtype=np.float32))


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


@dataclass(frozen=True)
class ClickedPoses:
    """Poses T_world_object (x y z m, qw qx qy qz) of objects at the first step, where known.

    `sd_m` is the standard deviation of each position on each axis of the table.
    """

    objects: tuple[SceneObject, ...]
    poses: Float64[np.ndarray, "objects 7"]
    known: Bool[np.ndarray, " objects"]
    sd_m: Float64[np.ndarray, " objects"]

    def track(self, num_steps: int) -> ObjectTrack:
        """As poses at the first step alone, and at every step of fixed objects."""
        fixed = np.array([one.fixed for one in self.objects])
        at_step = (np.arange(num_steps) == 0)[:, None] | fixed
        return ObjectTrack(
            np.tile(self.poses.astype(np.float32), (num_steps, 1, 1)),
            at_step & self.known,
            tuple("clicks" if known else "none" for known in self.known.tolist()),
            self.sd_m.astype(np.float32),
        )


@dataclass(frozen=True)
class _View:
    """The image of the first step: size (px), camera, height of the table, and what to call it."""

    size_px: tuple[int, ...]
    camera: tuple[Float64[np.ndarray, "3 3"], Distortion]
    T_world_camera: Float64[np.ndarray, "4 4"]
    table_z_m: float
    where: str


def first_camera(
    about: EpisodeAttributes,
) -> tuple[tuple[np.ndarray, np.ndarray], Float64[np.ndarray, "4 4"]]:
    """K (px) and distortion of an episode's head camera, and T_world_camera at its first step."""
    camera = about.K_head_matrix(), about.head_distortion()
    return camera, about.anchor.to_poses().T_world_camera_head


def listed_objects(about: EpisodeAttributes, objects: SceneObjects) -> tuple[SceneObject, ...]:
    """The objects that a file lists for an episode's task.

    Raises UnknownNameError without the task, InvalidInputError if the episode has other objects.
    """
    if about.task not in objects.tasks:
        raise UnknownNameError("task of the objects", about.task, list(objects.tasks))
    listed = objects.tasks[about.task]
    names = tuple(one.name for one in listed)
    if about.object_names not in {(), names}:
        raise InvalidInputError(
            f"episode {about.episode_id!r}: has the objects {list(about.object_names)}, and the "
            f"file of objects {list(names)}; expected the same in the same order"
        )
    return listed


def clicked_poses(
    about: EpisodeAttributes,
    objects: SceneObjects,
    clicks: EpisodeClicks,
    *,
    may_lack_headings: bool = False,
) -> ClickedPoses:
    """Poses of an episode's objects at its first step.

    Objects that were not clicked, or are hidden, are unknown; absent ones are known to be away. If
    they `may_lack_headings`, an object whose second click is missing is unknown, and not refused.

    Raises:
        UnknownNameError: a task or an object that the file of objects does not have.
        InvalidInputError: a click outside the image or beside the table, or a missing or too near
            second click.
    """
    listed = listed_objects(about, objects)
    names = [one.name for one in listed]
    for name in clicks.objects:
        if name not in names:
            raise UnknownNameError(f"object of episode {about.episode_id!r}", name, names)
    sizes_px = [stream.shape[1::-1] for stream in about.streams if stream.name == HEAD_CAMERA]
    if not sizes_px:
        raise InvalidInputError(f"episode {about.episode_id!r}: has no {HEAD_CAMERA} to click in")
    camera, T_world_camera = first_camera(about)
    poses = np.tile(_ABSENT_POSE, (len(listed), 1))
    known, sd_m = np.zeros(len(listed), dtype=np.bool_), np.zeros(len(listed))
    for index, one in enumerate(listed):
        click = clicks.objects.get(one.name)
        if click is None or click.state == "hidden":
            continue
        where = f"episode {about.episode_id!r}, object {one.name!r}"
        lacks = click.heading_px is None and not one.click.symmetric
        if click.point_px is not None:
            if lacks and not may_lack_headings:
                raise InvalidInputError(
                    f"{where}: has no heading_px, which an object needs that is not symmetric; "
                    f"click a second point along its axis {one.click.heading}"
                )
            view = _View(sizes_px[0], camera, T_world_camera, objects.table_z_m, where)
            poses[index], sd_m[index] = _pose(one, (click.point_px, click.heading_px), view)
        known[index] = click.state == "absent" or not lacks
    return ClickedPoses(listed, poses, known, sd_m)


def _pose(
    one: SceneObject, places_px: tuple[Pixel, Pixel | None], view: _View
) -> tuple[Float64[np.ndarray, "7"], float]:
    """Pose of an object, and the standard deviation of its position on each axis of the table."""
    point_px, heading_px = places_px
    given = one.click.point_m
    up, box_m = _axis(one.click.up), np.array(one.box_m)
    point_m = box_m[:3] + float(np.abs(up) @ box_m[3:]) * up if given is None else np.array(given)
    z_m = standing_height_m(one, view.table_z_m) + float(up @ point_m)
    here_m = _on_level(point_px, z_m, view, "point_px")
    direction = np.array([1.0, 0.0, 0.0])
    if heading_px is not None and not one.click.symmetric:
        way_m = _on_level(heading_px, z_m, view, "heading_px") - here_m
        length_m = float(np.linalg.norm(way_m))
        if length_m < LEAST_HEADING_M:
            raise InvalidInputError(
                f"{view.where}: heading_px is {1e3 * length_m:.0f} mm from point_px on the table, "
                f"expected at least {1e3 * LEAST_HEADING_M:.0f} mm; click farther along its axis "
                f"{one.click.heading}"
            )
        direction = way_m / length_m
    R = standing_rotation(one, direction)
    pose = pose_from_transform(transform(R, here_m - R @ point_m))
    # How far a pixel along each axis of the image is on the table.
    shifts = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    around_m, _ = points_on_level(point_px + shifts, view.camera, view.T_world_camera, z_m)
    spread_m = np.linalg.norm(around_m[::2] - around_m[1::2])
    return pose, CLICK_SD_PX * float(spread_m) / np.sqrt(2.0)


def standing_height_m(one: SceneObject, table_z_m: float) -> float:
    """Height (m) of the origin of an object's frame in the world, as it stands at the start."""
    up, box_m = _axis(one.click.up), np.array(one.box_m)
    return table_z_m + one.click.base_m + float(np.abs(up) @ box_m[3:]) - float(up @ box_m[:3])


def standing_rotation(
    one: SceneObject, direction: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3 3"]:
    """R_world_object as it stands at the start, with its heading along a level unit direction."""
    up, ahead = _axis(one.click.up), _axis(one.click.heading)
    level = np.array([0.0, 0.0, 1.0])
    in_world = np.stack([level, direction, np.cross(level, direction)], axis=1)
    return in_world @ np.stack([up, ahead, np.cross(up, ahead)])


def _axis(name: str) -> Float64[np.ndarray, "3"]:
    return (-1.0 if name[0] == "-" else 1.0) * np.eye(3)["xyz".index(name[-1])]


def _on_level(pixel: Pixel, z_m: float, view: _View, what: str) -> Float64[np.ndarray, "3"]:
    """What a pixel shows at a height; refuses those outside the image, and rays that miss it."""
    if not ((np.zeros(2) <= pixel) & (pixel <= np.array(view.size_px))).all():
        raise InvalidInputError(
            f"{view.where}: {what} is {list(pixel)}, expected a place in the image of "
            f"{view.size_px[0]} by {view.size_px[1]} px"
        )
    (point_m,), (is_hit,) = points_on_level(
        np.array([pixel]), view.camera, view.T_world_camera, z_m
    )
    if not is_hit or np.linalg.norm(point_m) > _REACH_M:
        raise InvalidInputError(
            f"{view.where}: the ray of {what} {list(pixel)} does not meet the height {z_m:.3f} m "
            f"in front of the camera and within {_REACH_M:g} m of the world's origin; click on the "
            "object, or correct table_z_m, box_m and click in the file of objects"
        )
    return point_m
