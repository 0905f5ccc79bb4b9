"""Streams of the poses of a task's objects, from markers in images or from trackers.

An object has samples only where it was seen, so that gaps show where it was not.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.episodes import RecordingReader
from dextouch.errors import InvalidInputError
from dextouch.geometry import pose_from_transform, transform, transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import SceneObject, SceneObjects
from dextouch.streams import HEAD_CAMERA, StreamDescriptor
from services.alignment.synchronization.progress import OnProgress, progress_within
from services.alignment.synchronization.recorded_streams import (
    Block,
    Conversion,
    DatedStream,
    EpisodeStream,
    moved_poses,
)
from services.alignment.synchronization.resampling import (
    place_on_grid,
    poses_on_grid,
    stream_gap_ns,
)

if TYPE_CHECKING:
    from services.alignment.marker_poses import TrackedObject

# Images that are decoded at once.
_IMAGES_AT_ONCE: Final = 32
_MOST_COMPARED: Final = 64


def with_tracked_objects(
    streams: Mapping[str, DatedStream], objects: SceneObjects | None
) -> dict[str, DatedStream]:
    """The streams, those of trackers on objects moved to the objects.

    Raises:
        InvalidInputError: a stream that is needed is missing, or an object has two sources.
    """
    changed = dict(streams)
    for one in _listed(objects):
        stream = streams.get(one.stream)
        if one.markers:
            missing = [name for name in (HEAD_CAMERA, "head") if name not in streams]
            if missing or stream is not None:
                raise InvalidInputError(
                    f"object {one.name!r}: has markers, and the recording "
                    + (f"has no {missing}" if missing else f"a stream {one.stream!r} of its own")
                    + "; expected the streams of the head camera and its pose, and one source of "
                    "the object's pose"
                )
        elif stream is None or stream.descriptor.kind != "pose":
            raise InvalidInputError(
                f"object {one.name!r}: has no markers, and the recording has no poses "
                f"{one.stream!r}; put a tracker with this stream name on it, or give its markers "
                "in the file of objects"
            )
        elif one.tracker_pose is not None:
            T = transform_from_pose(np.array(one.tracker_pose))
            convert = partial(_moved_on, first=stream.convert, T_tracker_object=T)
            changed[one.stream] = replace(stream, convert=convert)
    return changed


def _moved_on(poses: np.ndarray, *, first: Conversion, T_tracker_object: np.ndarray) -> np.ndarray:
    return moved_poses(first(poses), T_world_base=None, T_tracker_body=T_tracker_object)


def marker_streams(
    recording: RecordingReader,
    streams: Mapping[str, DatedStream],
    objects: SceneObjects | None,
    inside_ns: tuple[int, int],
    *,
    max_gap_ns: int,
    on_progress: OnProgress = lambda _: None,
) -> list[EpisodeStream]:
    """Poses of the objects that have markers; objects that were never seen are omitted.

    Args:
        recording: its calibration has K_head and, of a lens with distortion, distortion_head.
        streams: of the recording, by name.
        objects: of the recording's task.
        inside_ns: host times of the first and the last step of the episode.
        max_gap_ns: longest gap between poses of the camera.
        on_progress: called as images are searched.
    """
    listed = [one for one in _listed(objects) if one.markers]
    if objects is None or not listed:
        return []
    from services.alignment.marker_poses import CameraLens, MarkerTracker

    camera = streams[HEAD_CAMERA]
    period_ns = camera.descriptor.period_ns()
    tracker = MarkerTracker(listed, objects.dictionary, CameraLens(*_lens(recording)))
    wanted = np.flatnonzero(
        (camera.t_ns >= inside_ns[0] - period_ns) & (camera.t_ns <= inside_ns[1] + period_ns)
    )
    places, Ts = _camera_poses(streams["head"], camera.t_ns, wanted, max_gap_ns)
    for low in range(0, len(places), _IMAGES_AT_ONCE):
        part = places[low : low + _IMAGES_AT_ONCE]
        kept = camera.timing.kept[part]
        damaged = recording.damaged_images(HEAD_CAMERA, kept)
        whole = np.isin(kept, damaged, invert=True)
        images = recording.images_at(HEAD_CAMERA, kept[whole])
        here = Ts[low : low + _IMAGES_AT_ONCE][whole]
        for t_ns, image, T in zip(camera.t_ns[part[whole]].tolist(), images, here, strict=True):
            tracker.add(t_ns - inside_ns[0], image, T)
        on_progress(progress_within("objects", low / len(places), HEAD_CAMERA))
    tracked = tracker.tracked()
    rate_hz = camera.descriptor.nominal_rate_hz
    return [
        _stream(one, tracked[one.name], rate_hz, camera.t_ns[wanted] - inside_ns[0])
        for one in listed
        if len(tracked[one.name].t_ns)
    ]


def _listed(objects: SceneObjects | None) -> tuple[SceneObject, ...]:
    return () if objects is None else next(iter(objects.tasks.values()))


def _lens(recording: RecordingReader) -> tuple[np.ndarray, np.ndarray]:
    """K and distortion of the head camera."""
    calibration = recording.attributes.calibration
    distortion = calibration.get("distortion_head", ((0.0,) * 5,))
    return np.array(calibration["K_head"]), np.array(distortion[0])


def _camera_poses(
    head: DatedStream, image_ns: np.ndarray, wanted: np.ndarray, max_gap_ns: int
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 4 4"]]:
    """Those of the wanted images at which the camera's pose is known, and the poses."""
    loaded = head.load()
    finite = np.isfinite(loaded.values).all(axis=1)
    period_ns = head.descriptor.period_ns()
    at = place_on_grid(
        loaded.t_ns[finite],
        image_ns[wanted],
        period_ns=period_ns,
        max_gap_ns=stream_gap_ns(max_gap_ns, period_ns),
    )
    if not at.valid.any():
        return np.zeros(0, dtype=np.int64), np.zeros((0, 4, 4))
    Ts = poses_on_grid(loaded.values[finite], at)
    return wanted[at.valid], Ts[at.valid]


def _stream(
    one: SceneObject,
    tracked: "TrackedObject",
    rate_hz: float,
    image_ns: Int64[np.ndarray, " images"],
) -> EpisodeStream:
    descriptor = StreamDescriptor(
        name=one.stream,
        kind="pose",
        shape=(7,),
        dtype="float64",
        unit="pose_m_wxyz",
        nominal_rate_hz=rate_hz,
        frame="world",
        device=HEAD_CAMERA,
    )
    quality = {
        f"{one.stream}_share_seen": len(tracked.t_ns) / max(len(image_ns), 1),
        f"{one.stream}_reprojection_px": float(np.median(tracked.reprojection_px)),
    }
    block = Block(tracked.t_ns, pose_from_transform(tracked.Ts_world_object))
    if one.fixed:
        pose = pose_from_transform(middle_transform(tracked.Ts_world_object))
        block = Block(image_ns, np.repeat(pose[None], len(image_ns), axis=0))
    return EpisodeStream(descriptor, _once(block), quality)


def middle_transform(Ts: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "4 4"]:
    """The median position, with the rotation that is nearest to all others."""
    some = Ts[:: 1 + len(Ts) // _MOST_COMPARED, :3, :3]
    apart_rad = rotation_angle(np.swapaxes(some, -1, -2)[:, None] @ some[None])
    return transform(some[np.argmin(apart_rad.sum(axis=1))], np.median(Ts[:, :3, 3], axis=0))


def _once(block: Block) -> Iterator[Block]:
    yield block
