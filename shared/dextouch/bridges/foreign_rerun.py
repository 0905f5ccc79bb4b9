"""Import of Rerun `.rrd` files, read by rerun-sdk: what one timeline holds becomes a recording."""

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.types as arrow_types
from rerun.chunk import Chunk, RrdReader

from dextouch.bridges.foreign import ImportAttributes, ImportReport
from dextouch.bridges.foreign_images import (
    RAW,
    check_codec,
    check_pixels,
    compressed_form,
    decode_png,
    decode_raw,
    raw_form,
)
from dextouch.bridges.foreign_messages import (
    MAX_POINTS,
    NUMBERS_UNIT,
    POSE_UNIT,
    VIDEO_UNIT,
    CameraModel,
    Form,
    Item,
)
from dextouch.bridges.foreign_streams import Reading, Survey, import_readings
from dextouch.episodes import EpisodeStore
from dextouch.errors import CorruptDataError, DexTouchError, InvalidInputError, NotFoundError
from dextouch.geometry import pose_from_transform
from dextouch.streams import JPEG_UNIT, NO_DEVICE_TIME

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
_VIDEO_CODECS: Final = {
    0x61766331: "h264",
    0x68657631: "h265",
    0x76703039: "vp9",
    0x61763031: "av1",
}
_CHILD_FROM_PARENT: Final = 2
Row = Mapping[str, Any]


def import_rrd(
    path: Path, store: EpisodeStore, about: ImportAttributes, *, timeline: str | None = None
) -> ImportReport:
    """Import the first recording of a file, with the times of a timeline as host times.

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
    chosen = _timeline(path, timeline)
    return import_readings(
        path, store, about, lambda survey: _Rows(path, chosen, survey).run(), form="rrd"
    )


def _chunks(path: Path) -> Iterator[Chunk]:
    try:
        yield from _opened(path)[0].stream()
    except (ValueError, RuntimeError, OSError, pa.ArrowException) as error:
        raise CorruptDataError(f"{path}: rerun-sdk cannot read it ({error})") from error


def _opened(path: Path) -> tuple[RrdReader, list[str]]:
    """The reader of a file, and its warnings: of a file without a footer, which may be cut."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        return RrdReader(path), [str(one.message) for one in said]


def _timeline(path: Path, name: str | None) -> str:
    found: dict[str, bool] = {}
    for chunk in _chunks(path):
        if not chunk.is_static:
            schema = chunk.to_record_batch().schema
            for one in chunk.timeline_names:
                found[one] = not arrow_types.is_integer(schema.field(one).type)
    timed = [one for one, is_time in found.items() if is_time]
    own = [one for one in timed if one not in _OF_LOGGING] or timed
    if name is None and len(own) == 1:
        return own[0]
    if name in timed:
        return str(name)
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
        # Newest value of each component by entity, static ones included: rows may leave them out.
        self._last: dict[str, dict[str, Any]] = {}

    def run(self) -> Iterator[Reading]:
        """Iterate over the rows, static ones first."""
        if self._survey is not None:
            for reason in _opened(self._path)[1]:
                self._survey.refuse(self._path.name, "file", reason)
        for chunk in _chunks(self._path):
            if chunk.is_static:
                self._remember(chunk)
        for chunk in _chunks(self._path):
            if not chunk.is_static:
                yield from self._rows(chunk)

    def _remember(self, chunk: Chunk) -> None:
        batch = chunk.to_record_batch()
        known = self._last.setdefault(chunk.entity_path, {})
        for name in _components(batch):
            for value in batch.column(name):
                if value.is_valid:
                    known[name] = value
        if self._survey is None or chunk.entity_path.startswith("/__"):
            return
        if (model := _pinhole(known)) is not None:
            self._survey.cameras[chunk.entity_path] = (model, 1)
        else:
            names = ", ".join(sorted(_components(batch)))[:200]
            reason = f"static ({names}), so without a time"
            self._survey.refuse(chunk.entity_path, "static", reason)

    def _rows(self, chunk: Chunk) -> Iterator[Reading]:
        entity, batch = chunk.entity_path, chunk.to_record_batch()
        known = self._last.setdefault(entity, {})
        names = _components(batch)
        readers = {_archetype(name) for name in names}
        schema = ", ".join(sorted(readers))
        if self._timeline not in chunk.timeline_names:
            for _ in range(batch.num_rows):
                yield Reading(entity, schema, 0, reason=f"not on the timeline {self._timeline!r}")
            return
        times = batch.column(self._timeline).cast("int64")
        columns = {name: batch.column(name) for name in names}
        for index in range(batch.num_rows):
            row = {name: column[index] for name, column in columns.items()}
            known.update({name: value for name, value in row.items() if value.is_valid})
            t_ns = times[index].as_py()
            if t_ns is None:
                yield Reading(entity, schema, 0, reason="row without a time")
                continue
            for archetype in readers:
                yield self._read(entity, archetype, t_ns, row)

    def _read(self, entity: str, archetype: str, t_ns: int, row: Row) -> Reading:
        reader = _READERS.get(archetype, partial(_numbers, archetype))
        frame = entity.rsplit("/", 1)[0].strip("/") or None
        try:
            items = tuple(reader(row, self._last[entity], frame))
        except DexTouchError as error:
            return Reading(entity, archetype, t_ns, reason=error.message)
        except (ValueError, TypeError, KeyError, pa.ArrowException) as error:
            reason = f"not a valid {archetype} ({type(error).__name__}: {error})"
            return Reading(entity, archetype, t_ns, reason=reason)
        return Reading(entity, archetype, t_ns, items=items)


def _components(batch: Any) -> list[str]:  # noqa: ANN401 - of pyarrow
    return [
        field.name for field in batch.schema if (field.metadata or {}).get(b"rerun:kind") == b"data"
    ]


def _archetype(component: str) -> str:
    return component.partition(":")[0]


def _item(form: Form, decode: Callable[[], Any], key: str = "") -> Item:
    return Item(key, form, NO_DEVICE_TIME, decode)


def _flat(value: Any) -> np.ndarray:  # noqa: ANN401 - of pyarrow
    """All numbers of an Arrow list, flat."""
    array = value.values
    while hasattr(array, "flatten") and arrow_types.is_nested(array.type):
        array = array.flatten()
    return np.asarray(array.to_numpy(zero_copy_only=False))


def _part(known: Mapping[str, Any], name: str, size: int) -> np.ndarray | None:
    """Numbers of a component that has one instance; None if it has none."""
    value = known.get(name)
    if value is None or not value.is_valid or len(value) == 0:
        return None
    return _flat(value)[:size].astype(np.float64)


def _transform(row: Row, known: Row, frame: str | None) -> Iterator[Item]:
    """The pose of the entity in its parent; Rerun has matrices by column and xyzw quaternions."""
    relation = _part(known, "Transform3D:relation", 1)
    if relation is not None and int(relation[0]) == _CHILD_FROM_PARENT:
        raise InvalidInputError("transform of the parent in the child; expected the other way")
    pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    t = _part(known, "Transform3D:translation", 3)
    q_xyzw = _part(known, "Transform3D:quaternion", 4)
    matrix = _part(known, "Transform3D:mat3x3", 9)
    for name in ("rotation_axis_angle", "scale"):
        if (value := known.get(f"Transform3D:{name}")) is not None and len(value):
            raise InvalidInputError(f"transform with {name}; expected a quaternion or a matrix")
    if q_xyzw is not None:
        pose[3:] = q_xyzw[[3, 0, 1, 2]]
    elif matrix is not None:
        T = np.eye(4)
        T[:3, :3] = matrix.reshape(3, 3).T
        pose = pose_from_transform(T)
    if t is not None:
        pose[:3] = t
    if t is not None or q_xyzw is not None or matrix is not None:
        yield _item(Form("pose", POSE_UNIT, "float64", (7,), frame), pose.copy)


def _points(row: Row, known: Row, frame: str | None) -> Iterator[Item]:
    value = row.get("Points3D:positions")
    if value is None or not value.is_valid:
        return
    points = _flat(value).reshape(-1, 3).astype("<f4")
    if not 1 <= len(points) <= MAX_POINTS:
        raise InvalidInputError(f"{len(points)} points, expected 1 … {MAX_POINTS}")
    form = Form(
        "scalar", NUMBERS_UNIT, "float32", points.shape, frame, ("x", "y", "z"),
        is_padded=True, as_numbers="points",
    )  # fmt: skip
    yield _item(form, points.copy)


def _image(archetype: str, row: Row, known: Row, frame: str | None) -> Iterator[Item]:
    value, form = row.get(f"{archetype}:buffer"), known.get(f"{archetype}:format")
    if value is None or not value.is_valid or not len(value):
        return
    if form is None or not len(form):
        raise InvalidInputError("image without a format")
    about = form[0].as_py()
    if about["pixel_format"]:
        raise InvalidInputError(f"pixel format {about['pixel_format']}; expected RGB or gray")
    encoding = _ENCODINGS.get((about["color_model"] or 0, about["channel_datatype"] or 0))
    if encoding is None:
        raise InvalidInputError(f"colour model and channels {about}; expected RGB or gray")
    yield _raw_item(encoding, about["height"], about["width"], _flat(value).tobytes(), frame)


def _raw_item(encoding: str, height: int, width: int, data: bytes, frame: str | None) -> Item:
    dtype, channels, _ = RAW[encoding]
    step = width * channels * np.dtype(dtype).itemsize
    unit, dtype, shape = raw_form(encoding, height, width, step, data)
    form = Form("image", unit, dtype, shape, frame)
    if dtype == "float32":
        form = replace(form, kind="scalar", as_numbers=f"pixels {encoding}")
    return _item(form, partial(decode_raw, encoding, shape, step, data, big_endian=False))


def _encoded_image(row: Row, known: Row, frame: str | None) -> Iterator[Item]:
    value = row.get("EncodedImage:blob")
    if value is None or not value.is_valid or not len(value):
        return
    unit, dtype, shape, data = compressed_form(_flat(value).tobytes())
    if unit == JPEG_UNIT:
        yield _item(Form("image", unit, dtype, shape, frame), lambda: data)
    else:
        form = Form("image", unit, dtype, shape, frame, notes=("PNG decoded",))
        yield _item(form, partial(decode_png, data, shape, dtype))


def _video(row: Row, known: Row, frame: str | None) -> Iterator[Item]:
    value, codec = row.get("VideoStream:sample"), _part(known, "VideoStream:codec", 1)
    if value is None or not value.is_valid or not len(value):
        return
    name = "unknown" if codec is None else _VIDEO_CODECS.get(int(codec[0]), str(int(codec[0])))
    check_codec(name)
    data = _flat(value).tobytes()
    yield _item(Form("image", VIDEO_UNIT + name, "uint8", (), frame), lambda: data)


def _numbers(archetype: str, row: Row, known: Row, frame: str | None) -> Iterator[Item]:
    """Numbers of Scalars and of components that no archetype of this reader has."""
    is_read = False
    for name, value in row.items():
        if _archetype(name) != archetype or not value.is_valid or not len(value):
            continue
        if arrow_types.is_nested(value.values.type) or not (
            arrow_types.is_floating(value.values.type) or arrow_types.is_integer(value.values.type)
        ):
            raise InvalidInputError(f"component {name}, which this release does not read")
        is_read = True
        numbers = _flat(value).astype("<f8")
        if len(numbers) > MAX_POINTS:
            raise InvalidInputError(f"{len(numbers)} numbers, expected at most {MAX_POINTS}")
        said = "" if archetype == "Scalars" else f"component {name}"
        form = Form("scalar", NUMBERS_UNIT, "float64", numbers.shape, frame, as_numbers=said)
        key = "" if archetype == "Scalars" else name.rsplit(":", 1)[-1]
        yield _item(form, numbers.copy, key)
    if not is_read:
        return


def _pinhole(known: Row) -> CameraModel | None:
    """A camera matrix, whose principal point Rerun counts as we do, from the image's corner."""
    K, size = _part(known, "Pinhole:image_from_camera", 9), _part(known, "Pinhole:resolution", 2)
    if K is None or size is None or K.size != 9:
        return None
    width_px, height_px = (int(one) for one in size)
    check_pixels(height_px, width_px)
    K = K.reshape(3, 3).T.ravel()
    return CameraModel("", (height_px, width_px), tuple(K.tolist()), (0.0,) * 5)


_READERS: Final[Mapping[str, Callable[[Row, Row, str | None], Iterator[Item]]]] = {
    "Transform3D": _transform,
    "Points3D": _points,
    "Image": partial(_image, "Image"),
    "DepthImage": partial(_image, "DepthImage"),
    "EncodedImage": _encoded_image,
    "VideoStream": _video,
}
