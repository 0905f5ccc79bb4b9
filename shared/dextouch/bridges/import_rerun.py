"""Import of Rerun `.rrd` files, read by rerun-sdk: what one timeline holds becomes a recording."""

import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.types as arrow_types
from rerun.chunk import Chunk, RrdReader
from rerun.error_utils import RerunWarning

from dextouch.bridges.import_images import RAW, check_codec, check_pixels
from dextouch.bridges.import_messages import (
    MAX_POINTS,
    NUMBERS_UNIT,
    POSE_UNIT,
    VIDEO_UNIT,
    CameraModel,
    Form,
    Item,
    encoded_image,
    raw_image,
)
from dextouch.bridges.import_recording import ImportAttributes, ImportReport, Refused
from dextouch.bridges.import_streams import Reading, Survey, import_readings
from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
)
from dextouch.geometry import pose_from_transform, rigid_error
from dextouch.streams import NO_DEVICE_TIME

# Timelines that Rerun adds to every call, used only where a file has no other with times.
_OF_LOGGING: Final = ("log_time", "log_tick")
# Colour models and channel types of rerun.datatypes by number, as encodings of raw images.
_ENCODINGS: Final = {
    (1, 6): "mono8",
    (1, 8): "mono16",
    (1, 34): "32FC1",
    (2, 6): "rgb8",
    (3, 6): "rgba8",
    (4, 6): "bgr8",
    (5, 6): "bgra8",
    (0, 6): "mono8",
    (0, 8): "mono16",
    (0, 34): "32FC1",
}
# rerun.components.VideoCodec are the four-character codes of MP4.
_VIDEO_CODECS = {0x61766331: "h264", 0x68657631: "h265", 0x76703039: "vp9", 0x61763031: "av1"}
_CHILD_FROM_PARENT: Final = 2
# How far R Rᵀ of a matrix may be from the identity (chosen: as of trackers' matrices).
RIGID_TOLERANCE: Final = 1e-3
_ROW_ID: Final = "rerun.controls.RowId"
# Values that are remembered of entities whose rows leave some out.
MAX_LATEST: Final = 4_000_000
# Components that count until they are set again, and those of the samples that they complete.
_COMPLETED_OF: Final[Mapping[str, tuple[str, ...]]] = {
    archetype: tuple(f"{archetype}:{name}" for name in names.split())
    for archetype, names in {
        "Transform3D": "translation quaternion mat3x3 rotation_axis_angle scale relation",
        "Image": "format",
        "DepthImage": "format meter",
        "VideoStream": "codec",
        "Pinhole": "image_from_camera resolution camera_xyz",
    }.items()
}
_COMPLETED: Final = frozenset(name for names in _COMPLETED_OF.values() for name in names)
_COMPLETING: Final = frozenset({"Image:buffer", "DepthImage:buffer", "VideoStream:sample"})
# What is read of each archetype; the rest is noted.
_READ: Final[Mapping[str, frozenset[str]]] = {
    "Points3D": frozenset({"Points3D:positions"}),
    "EncodedImage": frozenset({"EncodedImage:blob", "EncodedImage:media_type"}),
} | {
    archetype: _COMPLETING | {*names, f"{archetype}:is_keyframe"}
    for archetype, names in _COMPLETED_OF.items()
}
_USED_STATIC: Final = frozenset(
    {"Image:format", "DepthImage:format", "VideoStream:codec"}
    | {"Pinhole:image_from_camera", "Pinhole:resolution"}
)
Row = Mapping[str, Any]
# Components without the memory of their chunk (`_plain`).
Known = Mapping[str, Any]


def import_rrd(
    path: Path, store: EpisodeStore, about: ImportAttributes, *, timeline: str | None = None
) -> ImportReport:
    """Import the first recording of a file, with the times of a timeline as host times.

    Components that a row leaves out have their newest value, in order of time.
    Without a name the timeline is the only one with times beside Rerun's own, or else `log_time`.
    What is static or not on the timeline is in the report.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: no timeline with times, or several; or nothing can be imported.
        CorruptDataError: rerun-sdk cannot read the file.
        ConflictError: the id is in the store already.
    """
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file; expected a Rerun .rrd file")
    chosen, others = _timeline(path, timeline)
    report = import_readings(
        path, store, about, lambda survey: _Rows(path, chosen, survey).run(), form="rrd"
    )
    reason = f"left out; times are of {chosen!r}, when the samples were logged"
    report.refused += [Refused(other[:256], reason, "timeline") for other in others]
    return report


def _chunks(path: Path) -> Iterator[Chunk]:
    reader, first = opened_rrd(path)[0], None
    try:
        first = next(iter(reader.recordings()), None)
        yield from reader.stream(store=first)
    except (ValueError, RuntimeError, OSError, pa.ArrowException) as error:
        raise CorruptDataError(f"{path}: rerun-sdk cannot read it ({error})") from error


def opened_rrd(path: Path) -> tuple[RrdReader, list[str]]:
    """The reader of a file, and its warnings of a footer that lacks: the file may be cut.

    Warnings are recorded of the whole process; those of others are none of the file.
    """
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            reader = RrdReader(path)
        except (ValueError, RuntimeError, OSError, pa.ArrowException) as error:
            raise CorruptDataError(f"{path}: rerun-sdk cannot read it ({error})") from error
    return reader, [str(one.message) for one in said if issubclass(one.category, RerunWarning)]


def _timeline(path: Path, name: str | None) -> tuple[str, list[str]]:
    """The timeline, and those without times of a file that has no other with times of its own."""
    found: dict[str, bool] = {}
    for chunk in _chunks(path):
        if not chunk.is_static:
            schema = chunk.to_record_batch().schema
            for one in chunk.timeline_names:
                found[one] = not arrow_types.is_integer(schema.field(one).type)
    timed = [one for one, is_time in found.items() if is_time]
    own = [one for one in timed if one not in _OF_LOGGING] or timed
    if not found:
        raise InvalidInputError(f"{path}: holds nothing that was logged at a time")
    chosen = own[0] if name is None and len(own) == 1 else name
    if chosen in timed:
        others = sorted({*found} - {*_OF_LOGGING}) if chosen in _OF_LOGGING else []
        return str(chosen), others
    got = "none is given" if name is None else f"{name!r} is not one of them"
    raise InvalidInputError(
        f"{path}: has the timelines {sorted(found)}, of which {sorted(timed)} are times, and "
        f"{got}; name one with --timeline",
        timelines=sorted(timed),
    )


class _Rows:
    """One pass over a file; the first one has a survey, for what is no sample."""

    def __init__(self, path: Path, timeline: str, survey: Survey | None) -> None:
        self._path, self._timeline, self._survey = path, timeline, survey
        self._latest = _Latest()

    def run(self) -> Iterator[Reading]:
        self._note_file()
        for chunk in _chunks(self._path):
            if chunk.is_static:
                self._latest.add_static(chunk)
                self._note_static(chunk)
            elif self._timeline in chunk.timeline_names:
                self._latest.find_gaps(chunk)
        for entity, known in self._latest.static.items():
            if self._survey is not None and (model := _pinhole(known)) is not None:
                self._survey.note_camera(entity, model)
        if self._latest.has_gaps():
            self._latest.add_all(_chunks(self._path), self._timeline)
        for chunk in _chunks(self._path):
            if not chunk.is_static:
                yield from self._rows(chunk)

    def _note_file(self) -> None:
        if self._survey is not None:
            reader, said = opened_rrd(self._path)
            for reason in said:
                self._survey.refuse(self._path.name, "file", reason)
            names = [one.recording_id[:256] for one in reader.recordings()]
            for other in names[1:]:
                reason = f"one of several recordings; only the first, {names[0]!r}, is imported"
                self._survey.refuse(other, "recording", reason)

    def _note_static(self, chunk: Chunk) -> None:
        if self._survey is None or chunk.entity_path.startswith("/__"):
            return
        names = sorted({*_components(chunk.to_record_batch())} - _USED_STATIC)
        if names:
            reason = f"static ({', '.join(names)[:200]}), so without a time"
            self._survey.refuse(chunk.entity_path, "static", reason)

    def _rows(self, chunk: Chunk) -> Iterator[Reading]:
        entity, batch = chunk.entity_path, chunk.to_record_batch()
        names = _components(batch)
        readers = {_archetype(name) for name in names}
        schema = ", ".join(sorted(readers))
        if self._timeline not in chunk.timeline_names:
            for _ in range(batch.num_rows):
                yield Reading(entity, schema, 0, reason=f"not on the timeline {self._timeline!r}")
            return
        times = batch.column(self._timeline).cast("int64")
        ids = batch.column(_ROW_ID)
        columns = {name: batch.column(name) for name in names}
        for index in range(batch.num_rows):
            row = {name: column[index] for name, column in columns.items()}
            t_ns = times[index].as_py()
            if t_ns is None:
                yield Reading(entity, schema, 0, reason="row without a time")
                continue
            at = _moment(t_ns, ids[index].as_py())
            for archetype in readers:
                part = {n: v for n, v in row.items() if v.is_valid and _archetype(n) == archetype}
                if part:
                    known = self._latest.at(entity, archetype, at, part)
                    yield self._read(entity, archetype, t_ns, part, known)

    def _read(self, entity: str, archetype: str, t_ns: int, row: Row, known: Known) -> Reading:
        reader = _READERS.get(archetype, _numbers)
        frame = entity.rsplit("/", 1)[0].strip("/") or None
        try:
            if archetype == "Pinhole":
                return self._pinhole(entity, t_ns, known)
            items = tuple(_with_left_out(one, row) for one in reader(row, known, frame))
        except DexTouchError as error:
            return Reading(entity, archetype, t_ns, reason=error.message)
        except (ValueError, TypeError, KeyError, pa.ArrowException) as error:
            reason = f"not a valid {archetype} ({type(error).__name__}: {error})"
            return Reading(entity, archetype, t_ns, reason=reason)
        return Reading(entity, archetype, t_ns, items=items)

    def _pinhole(self, entity: str, t_ns: int, known: Known) -> Reading:
        model = _pinhole(known)
        if model is None:
            raise InvalidInputError("pinhole without a matrix and a resolution")
        if self._survey is not None:
            self._survey.note_camera(entity, model)
        left_out = "" if "Pinhole:camera_xyz" not in known else "left out: camera_xyz"
        return Reading(entity, "Pinhole", t_ns, reason=left_out)


class _Latest:
    """Newest values of the components that rows may leave out, by time and then by row id.

    The chunks of a file are in no order of time. Only entities with rows that leave some out
    (`find_gaps`) are kept in memory.
    """

    def __init__(self) -> None:
        self.static: dict[str, dict[str, Any]] = {}
        self._patterns: dict[tuple[str, str], set[frozenset[str]]] = {}
        self._history: dict[tuple[str, str], list[tuple[int, Any]]] = {}
        self._num_values = 0

    def add_static(self, chunk: Chunk) -> None:
        """Remember what counts at all times."""
        known = self.static.setdefault(chunk.entity_path, {})
        batch = chunk.to_record_batch()
        for name in _components(batch):
            for value in batch.column(name) if name in _COMPLETED else ():
                if value.is_valid:
                    known[name] = _plain(value)

    def find_gaps(self, chunk: Chunk) -> None:
        batch = chunk.to_record_batch()
        by_archetype: dict[str, list[str]] = {}
        for name in _components(batch):
            if name in _COMPLETED or name in _COMPLETING:
                by_archetype.setdefault(_archetype(name), []).append(name)
        for archetype, names in by_archetype.items():
            valid = np.stack(
                [batch.column(n).is_valid().to_numpy(zero_copy_only=False) for n in names], axis=-1
            )
            found = self._patterns.setdefault((chunk.entity_path, archetype), set())
            for row in np.unique(valid, axis=0) if len(found) < 2 else ():
                if row.any():
                    found.add(frozenset(n for n, has in zip(names, row, strict=True) if has))

    def has_gaps(self) -> bool:
        """Whether a row leaves out what another row of its entity has."""
        return any(len(found) > 1 for found in self._patterns.values())

    def add_all(self, chunks: Iterable[Chunk], timeline: str) -> None:
        """Remember the values of entities with gaps, in order of time."""
        for chunk in chunks:
            if not chunk.is_static and timeline in chunk.timeline_names:
                self._add(chunk, timeline)
        for found in self._history.values():
            found.sort(key=itemgetter(0))

    def _add(self, chunk: Chunk, timeline: str) -> None:
        entity, batch = chunk.entity_path, chunk.to_record_batch()
        times, ids = batch.column(timeline).cast("int64"), batch.column(_ROW_ID)
        for name in _components(batch):
            if name not in _COMPLETED or len(self._patterns[entity, _archetype(name)]) < 2:
                continue
            found = self._history.setdefault((entity, name), [])
            for t_ns, number, value in zip(times, ids, batch.column(name), strict=True):
                if value.is_valid and t_ns.is_valid:
                    found.append((_moment(t_ns.as_py(), number.as_py()), _plain(value)))
                    self._num_values += 1
            if self._num_values > MAX_LATEST:
                raise LimitExceededError(
                    f"more than {MAX_LATEST} values of entities whose rows leave some out"
                )

    def at(self, entity: str, archetype: str, moment: int, row: Row) -> Known:
        """Values of an archetype in a row, and the newest of those that it leaves out."""
        known = self.static.get(entity, {})
        found = {n: v for n, v in known.items() if _archetype(n) == archetype}
        for name in _COMPLETED_OF.get(archetype, ()):
            if name in row:
                found[name] = _plain(row[name])
            elif history := self._history.get((entity, name)):
                index = bisect_right(history, moment, key=itemgetter(0))
                if index:
                    found[name] = history[index - 1][1]
        return found


def _moment(t_ns: int, row_id: bytes) -> int:
    """A number that orders rows by time, and those of one time by their ids."""
    return (t_ns << 128) + int.from_bytes(row_id, "big")


def _plain(value: Any) -> Any:  # noqa: ANN401 - of pyarrow
    """A component without the memory of its chunk: numbers, or the dictionary of a structure."""
    if arrow_types.is_struct(value.values.type):
        return value[0].as_py() if len(value) else {}
    return _flat(value)[:16].astype(np.float64)


def _with_left_out(item: Item, row: Row) -> Item:
    """A sample with a note of its archetype's components that are not read."""
    archetype = next(iter(map(_archetype, row)))
    if archetype not in _READ:
        return item
    names = [
        n.partition(":")[2] for n, value in row.items() if n not in _READ[archetype] and len(value)
    ]
    if not names:
        return item
    notes = (*item.form.notes, f"left out: {', '.join(sorted(names))[:200]}")
    return replace(item, form=replace(item.form, notes=notes))


def _components(batch: Any) -> list[str]:  # noqa: ANN401 - of pyarrow
    return [
        field.name for field in batch.schema if (field.metadata or {}).get(b"rerun:kind") == b"data"
    ]


def _archetype(component: str) -> str:
    return component.partition(":")[0]


def _item(form: Form, decode: Callable[[], Any], key: str) -> Item:
    return Item(key, form, NO_DEVICE_TIME, decode)


def _flat(value: Any) -> np.ndarray:  # noqa: ANN401 - of pyarrow
    """All numbers of an Arrow list, flat."""
    array = value.values
    while hasattr(array, "flatten") and arrow_types.is_nested(array.type):
        array = array.flatten()
    return np.asarray(array.to_numpy(zero_copy_only=False))


def _part(known: Known, name: str, size: int) -> np.ndarray | None:
    """Numbers of a component that has one instance; None if it has none."""
    value = known.get(name)
    return None if value is None or not len(value) else np.asarray(value)[:size]


def _transform(row: Row, known: Known, frame: str | None) -> Iterator[Item]:
    """The pose of the entity in its parent; Rerun has matrices by column and xyzw quaternions."""
    relation = _part(known, "Transform3D:relation", 1)
    if relation is not None and int(relation[0]) == _CHILD_FROM_PARENT:
        raise InvalidInputError("transform of the parent in the child; expected the other way")
    pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    t = _part(known, "Transform3D:translation", 3)
    q_xyzw = _part(known, "Transform3D:quaternion", 4)
    matrix = _part(known, "Transform3D:mat3x3", 9)
    for name in ("rotation_axis_angle", "scale"):
        if len(known.get(f"Transform3D:{name}", ())):
            raise InvalidInputError(f"transform with {name}; expected a quaternion or a matrix")
    if q_xyzw is not None:
        pose[3:] = q_xyzw[[3, 0, 1, 2]]
    elif matrix is not None:
        T = np.eye(4)
        T[:3, :3] = matrix.reshape(3, 3).T
        if rigid_error(T) > RIGID_TOLERANCE:
            raise InvalidInputError("transform with a matrix that scales, shears or mirrors")
        pose = pose_from_transform(T)
    if t is not None:
        pose[:3] = t
    has_part = any(name in row for name in _COMPLETED_OF["Transform3D"])
    if has_part and not (t is None and q_xyzw is None and matrix is None):
        form = Form("pose", POSE_UNIT, "float64", (7,), frame)
        yield _item(form, pose.copy, "Transform3D")


def _points(row: Row, known: Known, frame: str | None) -> Iterator[Item]:
    value = row.get("Points3D:positions")
    if value is None:
        return
    points = _flat(value).reshape(-1, 3).astype("<f4")
    if not 1 <= len(points) <= MAX_POINTS:
        raise InvalidInputError(f"{len(points)} points, expected 1 … {MAX_POINTS}")
    form = Form(
        "scalar", NUMBERS_UNIT, "float32", points.shape, frame, ("x", "y", "z"),
        is_padded=True, as_numbers="points",
    )  # fmt: skip
    yield _item(form, points.copy, "Points3D")


def _image(archetype: str, row: Row, known: Known, frame: str | None) -> Iterator[Item]:
    value, about = row.get(f"{archetype}:buffer"), known.get(f"{archetype}:format")
    if value is None or not len(value):
        return
    if not about:
        raise InvalidInputError("image without a format")
    if about["pixel_format"]:
        raise InvalidInputError(f"pixel format {about['pixel_format']}; expected RGB or gray")
    encoding = _ENCODINGS.get((about["color_model"] or 0, about["channel_datatype"] or 0))
    if encoding is None:
        raise InvalidInputError(f"colour model and channels {about}; expected RGB or gray")
    dtype, channels, _ = RAW[encoding]
    step = about["width"] * channels * np.dtype(dtype).itemsize
    size_px = (about["height"], about["width"])
    form, decode = raw_image(encoding, size_px, step, _flat(value).tobytes())
    meter = _part(known, f"{archetype}:meter", 1)
    notes = () if meter is None else (f"DepthImage.meter left out: {meter[0]:g} are one metre",)
    yield _item(replace(form, frame=frame, notes=notes), decode, archetype)


def _encoded_image(row: Row, known: Known, frame: str | None) -> Iterator[Item]:
    value = row.get("EncodedImage:blob")
    if value is not None and len(value):
        form, decode = encoded_image(_flat(value).tobytes())
        yield _item(replace(form, frame=frame), decode, "EncodedImage")


def _video(row: Row, known: Known, frame: str | None) -> Iterator[Item]:
    value, codec = row.get("VideoStream:sample"), _part(known, "VideoStream:codec", 1)
    if value is None or not len(value):
        return
    name = "unknown" if codec is None else _VIDEO_CODECS.get(int(codec[0]), str(int(codec[0])))
    check_codec(name)
    data = _flat(value).tobytes()
    form = Form("image", VIDEO_UNIT + name, "uint8", (), frame)
    yield _item(form, lambda: data, "VideoStream")


def _numbers(row: Row, known: Known, frame: str | None) -> Iterator[Item]:
    """Numbers of Scalars and of components that no archetype of this reader has."""
    for name, value in row.items():
        if not len(value):
            continue
        if arrow_types.is_nested(value.values.type) or not (
            arrow_types.is_floating(value.values.type) or arrow_types.is_integer(value.values.type)
        ):
            raise InvalidInputError(f"component {name}, which this release does not read")
        numbers = _flat(value)
        is_large = numbers.dtype == np.uint64 and numbers.max() > np.iinfo(np.int64).max
        notes = ("above 2^53, rounded",) if is_large else ()
        numbers = numbers.astype("<i8" if numbers.dtype.kind in "iu" and not is_large else "<f8")
        if len(numbers) > MAX_POINTS:
            raise InvalidInputError(f"{len(numbers)} numbers, expected at most {MAX_POINTS}")
        is_scalars = _archetype(name) == "Scalars"
        said = "" if is_scalars else f"component {name}"
        dtype = numbers.dtype.name
        form = Form("scalar", NUMBERS_UNIT, dtype, numbers.shape, frame, as_numbers=said)
        yield _item(replace(form, notes=notes), numbers.copy, "Scalars" if is_scalars else name)


def _pinhole(known: Known) -> CameraModel | None:
    """A camera matrix, whose principal point Rerun counts as we do, from the image's corner."""
    K, size = _part(known, "Pinhole:image_from_camera", 9), _part(known, "Pinhole:resolution", 2)
    if K is None or size is None or K.size != 9:
        return None
    width_px, height_px = (int(one) for one in size)
    check_pixels(height_px, width_px)
    K = K.reshape(3, 3).T.ravel()
    return CameraModel(None, (height_px, width_px), tuple(K.tolist()), (0.0,) * 5)


_READERS: Final[Mapping[str, Callable[[Row, Known, str | None], Iterator[Item]]]] = {
    "Transform3D": _transform,
    "Points3D": _points,
    "Image": partial(_image, "Image"),
    "DepthImage": partial(_image, "DepthImage"),
    "EncodedImage": _encoded_image,
    "VideoStream": _video,
}
