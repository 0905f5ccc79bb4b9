"""Streams of a recording on the host's clock, converted piece by piece, and cut to one episode."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Bool, Float64, Int64, Shaped

from dextouch.episodes import GOP_IMAGES, RecordingReader
from dextouch.errors import InvalidInputError
from dextouch.geometry import (
    NUM_DISTORTION,
    distortion_of,
    pose_from_transform,
    transform,
    transform_from_pose,
)
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import Matrix, SceneObject, SceneObjects, matrix_rows
from dextouch.streams import (
    ENCODED_UNITS,
    H264_UNIT,
    HEAD_CAMERA,
    MAX_MISSING,
    MOUNTS,
    Implausible,
    StreamDescriptor,
    check_camera_matrix,
    encoded_values,
)
from services.alignment.calibration.tactile_tare import (
    ABSENT,
    MAX_WRONG_TAXELS,
    OK,
    REASONS,
    TactileCalibration,
    taxel_faults,
    unusable_taxels,
)
from services.alignment.retargeting.wrist import (
    calibrated_transform,
    calibration_name,
    to_wrist_axes,
)
from services.alignment.synchronization import OnProgress, progress_within
from services.alignment.synchronization.resampling import (
    EDGE_PERIODS,
    place_on_grid,
    poses_on_grid,
    stream_gap_ns,
)
from services.alignment.synchronization.stream_clock import TimedStream, time_stream

if TYPE_CHECKING:
    from services.alignment.markers import TrackedObject

# A robot may report its wrists in its own base, whose pose in the world is calibrated.
BASE_FRAME = "base"
BASE_NAME = "T_world_base"
# Bytes of values that are read at once, as the episode holds them.
PIECE_BYTES = 16 << 20
# Encoded images that are in memory at once, a multiple of a group of pictures.
IMAGES_AT_ONCE = 8 * GOP_IMAGES
# Of a quaternion; trackers send zeros where they lost their target.
LEAST_NORM = 1e-9
# From raw values to those of the episode.
Conversion = Callable[[np.ndarray], np.ndarray]
# Images that are decoded at once, and poses of a fixed object that are compared.
_DECODED_AT_ONCE: Final = 32
_MOST_COMPARED: Final = 64


@dataclass(frozen=True)
class Block:
    """Consecutive samples of one stream in the units of the episode; finite."""

    t_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]


@dataclass(frozen=True)
class LoadedStream:
    """A stream with all its values; they may hold NaN (keypoints that were not seen)."""

    descriptor: StreamDescriptor
    t_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]


@dataclass(frozen=True)
class DatedStream:
    """One stream on the host's clock, as in the episode, whose values are read on demand.

    Keypoints that are `unseen` become NaN, `implausible` samples were found on the way.
    """

    recording: RecordingReader
    descriptor: StreamDescriptor
    timing: TimedStream
    convert: Conversion
    quality: dict[str, float] = field(default_factory=dict)
    calibration: dict[str, Matrix] = field(default_factory=dict)
    unseen: Bool[np.ndarray, "n nodes"] | None = None
    implausible: tuple[Implausible, ...] = ()

    @property
    def name(self) -> str:
        """The stream's name."""
        return self.descriptor.name

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """Times of all samples that have one of their own, on the host's clock."""
        return self.timing.t_host_ns

    def pieces(self, first: int = 0, stop: int | None = None) -> Iterator[Block]:
        """Samples first … stop−1 of those that have a time, in pieces; values may hold NaN."""
        kept = self.timing.kept[first:stop]
        t_ns = self.t_ns[first:stop]
        rows = max(1, PIECE_BYTES // max(self.descriptor.sample_bytes(), 1))
        for low in range(0, len(kept), rows):
            part = kept[low : low + rows]
            start = int(part[0])
            raw = self.recording.values(self.name, start, int(part[-1]) + 1)
            if len(raw) != len(part):
                raw = raw[part - start]
            values = self.convert(raw)
            if self.unseen is not None:
                hidden = self.unseen[first + low : first + low + len(part), :, None]
                values = np.where(hidden, np.nan, values)
            yield Block(t_ns[low : low + rows], values)

    def load(self, of: Conversion = np.asarray) -> LoadedStream:
        """All samples, or a function `of` them, at once; the descriptor remains that of samples."""
        pieces = [of(piece.values) for piece in self.pieces()]
        empty = np.empty((0, *self.descriptor.shape), dtype=self.descriptor.numpy_dtype())
        values = np.concatenate(pieces) if pieces else of(empty)
        return LoadedStream(self.descriptor, self.t_ns, values)


@dataclass
class EpisodeStream:
    """A stream of an episode, produced while it is written; then `quality` is complete."""

    descriptor: StreamDescriptor
    blocks: Iterator[Block]
    quality: dict[str, float] = field(default_factory=dict)


def date_stream(recording: RecordingReader, name: str) -> DatedStream:
    """Fit the clock of one stream and choose the conversion of its values.

    Raises ClockFitError; InvalidInputError: a wrong calibration; UnknownNameError: no stream.
    """
    descriptor, calibration = recording.streams[name], recording.attributes.calibration
    timing = time_stream(
        recording.stamps(name),
        descriptor,
        latency_ns=round(_nanoseconds(calibration, f"{name}_latency_ns") or 0.0),
        latency_sigma_ns=_nanoseconds(calibration, f"{name}_latency_sigma_ns"),
    )
    convert: Conversion = np.asarray
    if descriptor.kind == "tactile":
        raw = DatedStream(recording, descriptor, timing, convert)
        is_done = descriptor.unit == "kPa"
        return _without_absent(raw) if is_done else _pressures(raw, calibration)
    if descriptor.kind == "keypoints":
        descriptor = descriptor.model_copy(update={"dtype": "float64"})
        side, convert = descriptor.side, partial(np.asarray, dtype=np.float64)
        T = None if side is None else calibrated_transform(calibration, calibration_name(side))
        if T is not None:
            convert = partial(to_wrist_axes, T_keypoints_wrist=T)
    elif is_one_pose(descriptor):
        T_tracker_body = calibrated_transform(calibration, MOUNTS.get(name, ""))
        T_world_base = None
        if descriptor.frame == BASE_FRAME:
            T_world_base = calibrated_transform(calibration, BASE_NAME)
            if T_world_base is None:
                raise InvalidInputError(
                    f"stream {name!r}: poses are in the robot's base, and calibration "
                    f"{BASE_NAME!r} (4 by 4) is missing; run dextouch station calibrate "
                    "robot-base, or send poses in the world",
                    missing=[BASE_NAME],
                )
            descriptor = descriptor.model_copy(update={"frame": "world"})
        convert = partial(moved_poses, T_world_base=T_world_base, T_tracker_body=T_tracker_body)
    return DatedStream(recording, descriptor, timing, convert)


def is_one_pose(descriptor: StreamDescriptor) -> bool:
    """Whether samples are poses of one body, not of several as other programs send them."""
    return descriptor.kind == "pose" and descriptor.shape == (7,)


def cut_stream(stream: DatedStream, origin_ns: int, last_ns: int) -> EpisodeStream:
    """Samples from host time `origin_ns` on for `last_ns`, with the neighbours of the ends."""
    margin_ns = round(EDGE_PERIODS * stream.descriptor.period_ns())
    edges_ns = [origin_ns - margin_ns, origin_ns + last_ns + margin_ns]
    first = int(np.searchsorted(stream.t_ns, edges_ns[0], side="left"))
    stop = int(np.searchsorted(stream.t_ns, edges_ns[1], side="right"))
    quality: dict[str, float] = {}
    if stream.descriptor.unit not in ENCODED_UNITS:
        source = _complete_blocks(stream, (first, stop), quality)
    else:
        source = _image_blocks(stream, first, stop, quality)
    blocks = (Block(block.t_ns - origin_ns, block.values) for block in source)
    return EpisodeStream(stream.descriptor, blocks, quality)


def check_lens(stream: StreamDescriptor, calibration: Mapping[str, Matrix], *, where: str) -> None:
    """Refuse matrices that are no camera's, or were measured on images of another size."""
    camera = stream.name.removeprefix("camera_")
    if stream.kind != "image" or camera == stream.name:
        return
    shapes = {f"K_{camera}": (3, 3), f"distortion_{camera}": (1, NUM_DISTORTION)}
    for name, shape in (shapes | {f"image_size_{camera}_px": (1, 2)}).items():
        found = np.shape(calibration[name]) if name in calibration else shape
        if found != shape:
            raise InvalidInputError(f"{where}: calibration {name!r} is {found}, expected {shape}")
    height_px, width_px = stream.shape[:2]
    size_px = calibration.get(f"image_size_{camera}_px", ((width_px, height_px),))[0]
    if tuple(size_px) != (width_px, height_px):
        raise InvalidInputError(
            f"{where}: K_{camera} was measured on images of {size_px[0]:g} by {size_px[1]:g} px, "
            f"but {stream.name!r} holds {width_px} by {height_px}; calibrate the camera in the "
            "mode that is recorded"
        )
    if f"K_{camera}" in calibration:
        K = np.array(calibration[f"K_{camera}"])
        check_camera_matrix(K, (width_px, height_px), where=f"{where}: K_{camera}")


def _nanoseconds(calibration: dict[str, Matrix], name: str) -> float | None:
    """A number of the calibration; None if it is missing."""
    matrix = calibration.get(name)
    if matrix is None:
        return None
    if np.shape(matrix) != (1, 1):
        raise InvalidInputError(f"calibration {name!r}: got {np.shape(matrix)}, expected (1, 1)")
    return float(matrix[0][0])


def _pressures(raw: DatedStream, calibration: dict[str, Matrix]) -> DatedStream:
    """Pressures in kPa of any maker's glove; unusable taxels are zero and counted by reason."""
    name, side = raw.name, raw.descriptor.side
    if side is None:
        raise InvalidInputError(f"stream {name!r}: has no side, expected left or right")
    if len(raw.descriptor.shape) != 1:
        raise InvalidInputError(
            f"stream {name!r}: got samples of {raw.descriptor.shape}, expected a row of cells"
        )
    num_cells = raw.descriptor.shape[0]
    layout = raw.descriptor.layout
    glove = TactileCalibration.from_record(
        calibration, side, num_cells=num_cells, stream=name, layout=layout
    )
    take = taxel_faults(
        glove, (piece.values for piece in raw.pieces()), raw.descriptor.tactile_layout
    )
    refused = unusable_taxels(glove, take)
    listed = _with_refused(raw, refused)
    quality = dict(listed.quality)
    if len(take.zero_kpa):
        quality[f"{name}_highest_zero_kpa"] = float(take.zero_kpa.max())
    in_kpa = {"shape": (len(glove.cells),), "dtype": "float32", "unit": "kPa"}
    return replace(
        listed,
        descriptor=raw.descriptor.model_copy(update=in_kpa),
        convert=partial(glove.to_kpa, refused=refused),
        quality=quality,
        implausible=tuple(take.repeats()),
    )


def _without_absent(stream: DatedStream) -> DatedStream:
    """Pressures as they are; those of often missing taxels (`MAX_MISSING`) are zero and listed."""
    num_missing = sum((~np.isfinite(piece.values)).sum(axis=0) for piece in stream.pieces())
    is_absent = np.asarray(num_missing > MAX_MISSING * len(stream.t_ns))
    if not 0 < is_absent.mean() <= MAX_WRONG_TAXELS:
        return stream
    listed = _with_refused(stream, np.where(is_absent, ABSENT, OK))
    return replace(listed, convert=lambda kpa: np.where(is_absent, np.float32(0.0), kpa))


def _with_refused(stream: DatedStream, refused: np.ndarray) -> DatedStream:
    """A glove's stream that counts its refused taxels by reason, and lists them."""
    name = stream.name
    quality = {f"{name}_num_refused_taxels": float(np.count_nonzero(refused))}
    for state in np.unique(refused[refused > 0]).tolist():
        quality[f"{name}_num_{REASONS[state]}_taxels"] = float(np.count_nonzero(refused == state))
    states = {f"{name}_refused_taxels": matrix_rows(refused.reshape(1, -1).astype(np.float64))}
    return replace(stream, quality=quality, calibration=states)


def moved_poses(
    poses: np.ndarray, *, T_world_base: np.ndarray | None, T_tracker_body: np.ndarray | None
) -> np.ndarray:
    """Poses of the body in the world; NaN for invalid poses (not finite, zero quaternion)."""
    is_turned = np.linalg.norm(poses[:, 3:], axis=1) >= LEAST_NORM
    is_pose = is_turned & np.isfinite(poses).all(axis=1)
    moved = np.where(is_pose[:, None], poses, np.nan).astype(poses.dtype)
    if is_pose.any() and (T_world_base is not None or T_tracker_body is not None):
        Ts = transform_from_pose(poses[is_pose])
        Ts = Ts if T_world_base is None else T_world_base @ Ts
        Ts = Ts if T_tracker_body is None else Ts @ T_tracker_body
        moved = np.full(poses.shape, np.nan)
        moved[is_pose] = pose_from_transform(Ts)
    return moved


def _complete_blocks(
    stream: DatedStream, inside: tuple[int, int], quality: dict[str, float]
) -> Iterator[Block]:
    """Samples inside without NaN or infinity; those of the whole recording that have some count."""
    can_miss = stream.descriptor.numpy_dtype().kind == "f"
    num_incomplete = 0
    first, stop = (0, len(stream.t_ns)) if can_miss else inside
    for piece in stream.pieces(first, stop):
        values, t_ns = piece.values, piece.t_ns
        numbers = first + np.arange(len(t_ns))
        first += len(t_ns)
        taken = (numbers >= inside[0]) & (numbers < inside[1])
        if can_miss:
            whole = np.isfinite(values).reshape(len(values), -1).all(axis=1)
            num_incomplete += int((~whole).sum())
            taken &= whole
        if taken.all():
            yield piece
        elif taken.any():
            yield Block(t_ns[taken], values[taken])
    if num_incomplete:
        quality[f"{stream.name}_num_incomplete"] = float(num_incomplete)


def _image_blocks(
    stream: DatedStream, first: int, stop: int, quality: dict[str, float]
) -> Iterator[Block]:
    """Images as they were encoded; those that repeat the one before are counted."""
    kept = stream.timing.kept
    if stop <= first:
        return
    if stream.descriptor.unit == H264_UNIT:
        # A group of pictures goes over whole: the images before the first one that is needed too.
        first = max(0, first - int(kept[first]) % GOP_IMAGES)
        begins_group = int(kept[first]) % GOP_IMAGES == 0
        if not begins_group or int(kept[stop - 1] - kept[first]) != stop - 1 - first:
            # Images without a timestamp are in between: the rest is not a complete group.
            damaged = stream.recording.damaged_images(stream.name, kept[first:stop])
            places = first + np.flatnonzero(np.isin(kept[first:stop], damaged, invert=True))
            quality[f"{stream.name}_num_images_encoded_anew"] = float(len(places))
            rows = max(1, PIECE_BYTES // stream.descriptor.sample_bytes())
            for low in range(0, len(places), rows):
                part = places[low : low + rows]
                pictures = stream.recording.images_at(stream.name, kept[part])
                yield Block(stream.t_ns[part], pictures)
            return
    last = b""
    for low in range(first, stop, IMAGES_AT_ONCE):
        part = kept[low : min(low + IMAGES_AT_ONCE, stop)]
        start = int(part[0])
        images = stream.recording.encoded_images(stream.name, start, int(part[-1]) + 1)
        chosen = [images[number] for number in (part - start).tolist()]
        # Bytes of two images are equal only if a camera sends one twice.
        again = sum(one == before for before, one in pairwise([last, *chosen]))
        if again:
            name = f"{stream.name}_num_repeated_images"
            quality[name] = quality.get(name, 0.0) + again
        last = chosen[-1]
        yield Block(stream.t_ns[low : low + len(part)], encoded_values(chosen))


def with_tracked_objects(
    streams: Mapping[str, DatedStream],
    objects: SceneObjects | None,
    calibration: Mapping[str, Matrix],
) -> dict[str, DatedStream]:
    """The streams, those of trackers on objects moved to these; raises InvalidInputError."""
    changed = dict(streams)
    for one in _listed(objects):
        stream = streams.get(one.stream)
        if one.markers:
            missing = [name for name in (HEAD_CAMERA, "head") if name not in streams]
            missing += [] if "K_head" in calibration else ["calibration K_head"]
            if missing or stream is not None:
                raise InvalidInputError(
                    f"object {one.name!r}: has markers, and the recording "
                    + (f"has no {missing}" if missing else f"a stream {one.stream!r} of its own")
                    + "; expected the streams of the head camera and its pose, its matrix, and one "
                    "source of the object's pose"
                )
        elif stream is None or not is_one_pose(stream.descriptor):
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
    """Poses of the objects with markers that the head camera saw between two host times."""
    listed = [one for one in _listed(objects) if one.markers]
    if objects is None or not listed:
        return []
    from services.alignment.markers import MarkerTracker

    camera = streams[HEAD_CAMERA]
    period_ns = camera.descriptor.period_ns()
    calibration = recording.attributes.calibration
    K = np.array(calibration["K_head"])
    tracker = MarkerTracker(listed, objects.dictionary, K, distortion_of(calibration, "head"))
    selected = np.flatnonzero(
        (camera.t_ns >= inside_ns[0] - period_ns) & (camera.t_ns <= inside_ns[1] + period_ns)
    )
    places, Ts = _camera_poses(streams["head"], camera.t_ns, selected, max_gap_ns)
    for low in range(0, len(places), _DECODED_AT_ONCE):
        part = places[low : low + _DECODED_AT_ONCE]
        kept = camera.timing.kept[part]
        damaged = recording.damaged_images(HEAD_CAMERA, kept)
        whole = np.isin(kept, damaged, invert=True)
        images = recording.images_at(HEAD_CAMERA, kept[whole])
        poses = Ts[low : low + _DECODED_AT_ONCE][whole]
        for t_ns, image, T in zip(camera.t_ns[part[whole]].tolist(), images, poses, strict=True):
            tracker.add(t_ns - inside_ns[0], image, T)
        on_progress(progress_within("objects", low / len(places), HEAD_CAMERA))
    tracked = tracker.tracked()
    rate_hz = camera.descriptor.nominal_rate_hz
    return [
        _stream(one, tracked[one.name], rate_hz, camera.t_ns[selected] - inside_ns[0])
        for one in listed
        if len(tracked[one.name].t_ns)
    ]


def _listed(objects: SceneObjects | None) -> tuple[SceneObject, ...]:
    return () if objects is None else next(iter(objects.tasks.values()))


def _camera_poses(
    head: DatedStream, image_ns: np.ndarray, selected: np.ndarray, max_gap_ns: int
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 4 4"]]:
    loaded = head.load()
    finite = np.isfinite(loaded.values).all(axis=1)
    period_ns = head.descriptor.period_ns()
    at = place_on_grid(
        loaded.t_ns[finite],
        image_ns[selected],
        period_ns=period_ns,
        max_gap_ns=stream_gap_ns(max_gap_ns, period_ns),
    )
    if not at.valid.any():
        return np.zeros(0, dtype=np.int64), np.zeros((0, 4, 4))
    Ts = poses_on_grid(loaded.values[finite], at)
    return selected[at.valid], Ts[at.valid]


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
    return EpisodeStream(descriptor, iter([block]), quality)


def middle_transform(Ts: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "4 4"]:
    """The median position, with the rotation that is nearest to all others."""
    some = Ts[:: 1 + len(Ts) // _MOST_COMPARED, :3, :3]
    apart_rad = rotation_angle(np.swapaxes(some, -1, -2)[:, None] @ some[None])
    return transform(some[np.argmin(apart_rad.sum(axis=1))], np.median(Ts[:, :3, 3], axis=0))
