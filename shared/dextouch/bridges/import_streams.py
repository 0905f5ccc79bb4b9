"""Streams found among the samples of a foreign file, in two passes over it."""

import math
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import ValidationError

from dextouch.bridges.export_files import Block
from dextouch.bridges.import_images import Losses, Video, VideoDecoder, check_pixels
from dextouch.bridges.import_messages import GROUP, VIDEO_UNIT, CameraModel, Form, Item
from dextouch.bridges.import_recording import (
    ForeignStream,
    ImportAttributes,
    ImportReport,
    Refused,
    new_attributes,
    stream_names,
    write_recording,
)
from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    UnknownNameError,
)
from dextouch.geometry import NUM_DISTORTION
from dextouch.hands.robot_hand import RobotHand
from dextouch.schemas import first_problems
from dextouch.streams import (
    H264_UNIT,
    JPEG_UNIT,
    MAX_STREAMS,
    NO_DEVICE_TIME,
    TAXEL_UNIT,
    StreamDescriptor,
    encoded_values,
)
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout

MAX_SOURCES: Final = 1000
MAX_SAMPLES: Final = 20_000_000
MAX_FORMS: Final = 16
MAX_GROUP_NAME: Final = 256
# Samples out of order are held until the end of the file to sort them.
MAX_HELD_BYTES: Final = 1 << 28
MAX_PENDING_BYTES: Final = 1 << 22
MAX_PENDING: Final = 4096
MIN_RATE_HZ, MAX_RATE_HZ = 1e-6, 10_000.0
_MAX_REASONS = 8
_NO_IMAGE: Final = "packet without an image (before a key frame, or damaged)"
_MIXED: Final = "float64, as not all samples are int64; rounded above 2^53"
_SIDES = ("left", "right")
# Names of rectified images, as image_proc of ROS has them: image_rect, image_rect_color.
_RECTIFIED: Final = re.compile(r"(^|[/_])rect(ified)?([/_]|$)")


@dataclass(frozen=True)
class Reading:
    """One record of a file: its samples, or the `reason` why there are none.

    `source` is its topic or entity, `schema` its type there, `t_ns` becomes t_host_ns.
    """

    source: str
    schema: str
    t_ns: int
    items: tuple[Item, ...] = ()
    reason: str = ""
    sequence: int = -1


Convert = Callable[[np.ndarray], np.ndarray]


def mapped_form(
    name: str, form: Form, layout: TactileLayout = DEXTOUCH_V1
) -> tuple[Form, Convert, str | None]:
    """Form, conversion and side of a source that is mapped to one of our own streams.

    Streams of other names stay as they are. Floats as touch are the taxels of a layout in kPa,
    integers the counts of its raw cells, unless there are as many as taxels.

    Raises InvalidInputError for a source that cannot be that stream.
    """
    side = next((one for one in _SIDES if one in name.split("_")), None)
    numbers = form.kind != "image"
    size = math.prod(form.shape)
    columns: list[int] = []
    if name.startswith("tactile_") and side:
        is_float = form.dtype.startswith("float") or size == layout.num_taxels
        count = layout.num_taxels if is_float else layout.num_raw_cells
        what = "taxels in kPa" if is_float else "raw cells"
        wanted = f"the {count} {what} of {layout.name!r} (--layout)"
        fits = numbers and size == count
        made = replace(
            form,
            kind="tactile",
            unit=TAXEL_UNIT if is_float else "counts",
            dtype="float32" if is_float else form.dtype,
            shape=(size,),
        )
    elif name.startswith("keypoints_") and side:
        rows = form.shape[0] if len(form.shape) == 2 else size // 3
        wanted = "points [n, 3] or poses [n, 7]"
        fits = numbers and ((len(form.shape) == 2 and form.shape[1] >= 3) or size == 3 * rows)
        made = replace(form, kind="keypoints", unit="m", dtype="float64", shape=(rows, 3))
    elif name.startswith("wrist_") or name == "head":
        wanted, fits, made = "poses of one body", form.kind == "pose" and form.shape == (7,), form
    elif name in {"joints_measured", "joints_commanded"}:
        wanted, fits = "numbers", numbers
        columns = _hand_columns(form)
        names = tuple(form.names[column] for column in columns) or form.names
        size = len(columns) or size
        made = replace(
            form, kind="robot_state", unit="rad", dtype="float64", shape=(size,), names=names
        )
    elif name.startswith("camera_"):
        wanted, fits, made = "images", not numbers, form
    else:
        return form, np.asarray, None
    if not fits:
        raise InvalidInputError(f"stream {name!r}: got {form.describe()}, expected {wanted}")
    if made == form:
        return form, np.asarray, side
    names = made.names if made.kind == "robot_state" else ()
    made = replace(made, names=names, is_padded=False, as_numbers="")
    dtype = np.dtype(made.dtype).newbyteorder("<")

    def convert(values: np.ndarray) -> np.ndarray:
        if made.kind == "keypoints" and values.ndim == 2:
            values = values[:, :3]
        values = values[columns] if columns else values
        return np.ascontiguousarray(values, dtype=dtype).reshape(made.shape)

    return made, convert, side


def _hand_columns(form: Form) -> list[int]:
    """Columns of the joints of both our hands, as `RobotHand` orders them; empty for others."""
    names = [name for side in _SIDES for name in RobotHand(side).joint_names]
    is_ours = len(form.shape) == 1 and set(names) <= set(form.names)
    return [form.names.index(name) for name in names] if is_ours else []


class _Part:
    """One stream of a source, in both passes."""

    def __init__(self, source: str, key: str, schema: str) -> None:
        self.source, self.key, self.schema = source, key, schema
        self.times = array("q")
        self.num_device = self._last_device_ns = 0
        self.rises = self.is_ordered = True
        self.num_bytes = 0
        self.forms: list[tuple[Form, int]] = []
        self.video: Video | None = None
        self.lost: Counter[str] = Counter()
        self.name, self.side = "", ""
        self._convert: Convert = np.asarray
        self._decoder: VideoDecoder | None = None
        self._losses: Losses | None = None
        self._stamps: dict[int, tuple[int, int, int]] = {}
        self._num_packets = 0
        self._rows: list[tuple[int, int, int]] = []
        self._values: list[np.ndarray | bytes] = []
        self._pending_bytes = 0

    # First pass.

    def observe(self, t_ns: int, item: Item) -> None:
        """Count a sample; raises as its video's size."""
        for index, (form, count) in enumerate(self.forms):
            if form.matches(item.form):
                longest = form if form.shape[:1] >= item.form.shape[:1] else item.form
                mixed = (_MIXED,) if form.dtype != item.form.dtype else ()
                if mixed or form.notes != item.form.notes:
                    notes = tuple(dict.fromkeys((*form.notes, *item.form.notes, *mixed)))
                    dtype = "float64" if mixed else form.dtype
                    longest = replace(longest, notes=notes[:_MAX_REASONS], dtype=dtype)
                self.forms[index] = (longest, count + 1)
                break
        else:
            if len(self.forms) >= MAX_FORMS:
                self.lost[f"more than {MAX_FORMS} different shapes"] += 1
                return
            self.forms.append((item.form, 1))
        if self.times and t_ns < self.times[-1]:
            self.is_ordered = False
        self.times.append(t_ns)
        if item.t_device_ns != NO_DEVICE_TIME:
            self.rises = self.rises and item.t_device_ns > self._last_device_ns
            self._last_device_ns = item.t_device_ns
            self.num_device += 1
        if item.form.unit.startswith(VIDEO_UNIT):
            self.video = self.video or Video(item.form.unit.removeprefix(VIDEO_UNIT))
            data = item.decode()
            self.video.add(data if isinstance(data, bytes) else b"")
            self.num_bytes += len(data)
        elif item.form.unit == JPEG_UNIT:
            self.num_bytes += len(item.decode())
        else:
            self.num_bytes += math.prod(item.form.shape) * np.dtype(item.form.dtype).itemsize

    # Between the passes.

    def plan(self, name: str, about: ImportAttributes) -> StreamDescriptor:
        """The stream; raises InvalidInputError or LimitExceededError if it cannot be one."""
        form = max(self.forms, key=lambda one: one[1])[0]
        self._source_form = form
        if form.is_padded:
            sample_bytes = math.prod(form.shape) * np.dtype(form.dtype).itemsize
            self.num_bytes = len(self.times) * sample_bytes
        if 0 in form.shape:
            raise InvalidInputError(f"samples without a number, {form.describe()}")
        if not self.is_ordered and (self.video or self.num_bytes > MAX_HELD_BYTES):
            raise LimitExceededError(
                "times go back, and there is too much to sort (or a video): sort the file by "
                "time first"
            )
        if self.video is not None:
            form = self._video_form(form, about.images)
        layout = about.layout or DEXTOUCH_V1
        form, self._convert, side = mapped_form(name, form, layout)
        self.form, self.name = form, name
        names = form.names if form.shape[-1:] == (len(form.names),) else ()
        try:
            return StreamDescriptor.model_validate(
                {
                    "name": name,
                    "kind": form.kind,
                    "shape": form.shape,
                    "dtype": form.dtype,
                    "unit": form.unit,
                    "nominal_rate_hz": self._rate_hz(),
                    "frame": form.frame,
                    "side": side,
                    "names": names,
                    "layout": about.layout if form.kind == "tactile" else None,
                    "capabilities": {
                        "device_time": self.rises and self.num_device == len(self.times)
                    },
                }
            )
        except ValidationError as error:
            raise InvalidInputError(first_problems(error)) from error

    def _video_form(self, form: Form, images: str) -> Form:
        video = self.video
        if video is None or video.size_px is None:
            raise InvalidInputError("video without an image that can be decoded")
        height_px, width_px = video.size_px
        check_pixels(height_px, width_px)
        note = "video kept"
        unit = H264_UNIT
        if not video.is_kept():
            unit = JPEG_UNIT if images == H264_UNIT and (height_px % 2 or width_px % 2) else images
            note = f"{video.codec} decoded" + ("" if unit == "rgb8" else f", encoded as {unit}")
            self._decoder = VideoDecoder(video.codec)
            self._losses = Losses(video.codec, 1e9 / self._rate_hz())
        shape = (height_px, width_px, 3)
        return replace(form, unit=unit, shape=shape, notes=(*form.notes, note))

    def _rate_hz(self) -> float:
        steps = np.diff(np.sort(np.frombuffer(self.times, dtype=np.int64)))
        steps = steps[steps > 0]
        rate_hz = 1e9 / float(np.median(steps)) if len(steps) else 1.0
        return min(max(rate_hz, MIN_RATE_HZ), MAX_RATE_HZ)

    def misfits(self) -> Iterator[Refused]:
        """Samples of other shapes than the stream's."""
        for form, count in self.forms:
            if not self._source_form.matches(form):
                other = self._source_form.describe()
                names = "of other names, " if form.describe() == other else ""
                yield self._refused(f"{form.describe()}, {names}and most are {other}", count)

    def losses(self) -> Iterator[Refused]:
        for reason, count in (+self.lost).items():
            yield self._refused(reason, count)

    def _refused(self, reason: str, count: int) -> Refused:
        return Refused(self.label, reason, self.schema, count)

    @property
    def label(self) -> str:
        """The source's name, with the key where it has several streams."""
        return f"{self.source}:{self.key}" if self.key else self.source

    # Second pass.

    def take(self, reading: Reading, item: Item) -> Iterator[Block]:
        """Decode a sample, and yield a block when there are enough."""
        if not self._source_form.matches(item.form):
            return
        stamps = (reading.t_ns, item.t_device_ns, reading.sequence)
        try:
            if self._decoder is not None:
                data = item.decode()
                self._decode_video(data if isinstance(data, bytes) else b"", stamps)
            else:
                value = item.decode()
                if isinstance(value, np.ndarray):
                    value = self._convert(self._source_form.fit(value, item.form))
                self._add(stamps, value)
        except DexTouchError as error:
            self._stamps.pop(self._num_packets - 1, None)
            if self._losses is not None:
                self._losses.lose()
            self._lose(error)
        if self.is_ordered and (
            self._pending_bytes >= MAX_PENDING_BYTES or len(self._rows) >= MAX_PENDING
        ):
            yield from self.flush()

    def _lose(self, error: DexTouchError) -> None:
        reason = error.message if len(self.lost) < _MAX_REASONS else "other reasons"
        self.lost[reason] += 1

    def _decode_video(self, data: bytes | None, stamps: tuple[int, int, int] | None) -> None:
        if self._decoder is None or self._losses is None:
            return
        if stamps is not None and data is not None:
            self._stamps[self._num_packets] = stamps
            self._losses.add(data, stamps[0])
            self._num_packets += 1
        num_corrupt = self._decoder.num_corrupt
        for number, frame in self._decoder.decode(data):
            known = self._stamps.pop(number, None)
            # Packets before that gave no image: before the first key frame, or damaged.
            for older in [one for one in self._stamps if one < number]:
                del self._stamps[older]
                self.lost[_NO_IMAGE] += 1
            if known is None or (frame.height, frame.width) != self.form.shape[:2]:
                self.lost["image of another size, or shown in another order than sent"] += 1
            elif not self._losses.is_right(number, is_keyframe=bool(frame.key_frame)):
                self.lost["image after lost packets, before the next key frame"] += 1
            else:
                self._add(known, self._decoder.to_rgb(frame))
        if self._decoder.num_corrupt > num_corrupt:
            self._losses.lose()

    def _add(self, stamps: tuple[int, int, int], value: np.ndarray | bytes) -> None:
        self._rows.append(stamps)
        self._values.append(value)
        self._pending_bytes += len(value) if isinstance(value, bytes) else value.nbytes

    def finish(self) -> Iterator[Block]:
        if self._decoder is not None:
            try:
                self._decode_video(None, None)
            except DexTouchError as error:
                self._lose(error)
            self.lost[_NO_IMAGE] += len(self._stamps)
        yield from self.flush()

    def flush(self) -> Iterator[Block]:
        """The samples that are pending, as one block."""
        if not self._rows:
            return
        rows = np.array(self._rows, dtype=np.int64)
        if isinstance(self._values[0], bytes):
            values = encoded_values([one for one in self._values if isinstance(one, bytes)])
        else:
            values = np.stack([np.asarray(one) for one in self._values])
        self._rows, self._values, self._pending_bytes = [], [], 0
        t_ns, t_device_ns, sequence = (np.ascontiguousarray(column) for column in rows.T)
        yield Block(t_ns, t_device_ns, sequence, values)


class Survey:
    """First pass: all streams of a file by source and key, and the records without samples."""

    def __init__(self) -> None:
        self.parts: dict[tuple[str, str], _Part] = {}
        self.cameras: dict[str, tuple[CameraModel, int]] = {}
        self.problems: Counter[tuple[str, str, str]] = Counter()
        # Schemas of the sources that the file announces.
        self.known: dict[str, str] = {}
        self.first_ns: int | None = None
        self._num_samples = 0

    def observe(self, reading: Reading) -> None:
        """Count the samples of a record."""
        if reading.reason:
            self.refuse(reading.source, reading.schema, reading.reason)
        for item in reading.items:
            key = (reading.source, item.key)
            if key not in self.parts:
                if len(self.parts) >= MAX_SOURCES:
                    self.refuse("(others)", "", f"more than {MAX_SOURCES} streams in the file")
                    continue
                self.parts[key] = _Part(*key, reading.schema)
            self._num_samples += 1
            if self._num_samples > MAX_SAMPLES:
                raise LimitExceededError(
                    f"more than {MAX_SAMPLES} samples in one file; split it (`mcap filter`, "
                    "`rerun rrd split`)"
                )
            if self.first_ns is None or reading.t_ns < self.first_ns:
                self.first_ns = reading.t_ns
            try:
                self.parts[key].observe(reading.t_ns, item)
            except DexTouchError as error:
                self.refuse(reading.source, reading.schema, error.message)

    def note_camera(self, source: str, model: CameraModel) -> None:
        """Count a calibration; the first of a source is used."""
        first, count = self.cameras.get(source, (model, 0))
        self.cameras[source] = (first, count + 1)
        if first != model:
            reason = "calibration that differs from the first one, which is used"
            self.refuse(source, "calibration", reason)

    def refuse(self, source: str, schema: str, reason: str) -> None:
        """Count a record without samples; past a number of reasons those of a source are one."""
        key = (source, schema, reason)
        if key not in self.problems and len(self.problems) >= _MAX_REASONS:
            reasons = sum(one[0] == source for one in self.problems)
            if reasons >= _MAX_REASONS or len(self.problems) >= 2 * MAX_SOURCES:
                key = (source, schema, "other reasons")
        self.problems[key] += 1

    def refused(self) -> list[Refused]:
        """Records without samples, and sources without records."""
        found = [Refused(s, reason, t, n) for (s, t, reason), n in self.problems.items()]
        sources = {source for source, _ in self.parts} | {one.source for one in found}
        sources |= set(self.cameras)
        empty = [(s, schema) for s, schema in self.known.items() if s not in sources]
        return found + [Refused(source, "no messages", schema) for source, schema in empty]

    def summary(self) -> str:
        """What has been read so far, in a sentence."""
        count = sum(len(part.times) for part in self.parts.values())
        return f"{count} samples of {len(self.parts)} streams were readable before"


def _name_groups(parts: Iterable[_Part]) -> None:
    """Keys of sources that several publish to, each with joints of its own (`GROUP`).

    Each gets the first name that none of the others has.
    """
    groups: dict[str, set[str]] = {}
    for part in parts:
        groups.setdefault(part.source, set()).add(part.key.partition(GROUP)[2])
    for part in parts:
        part.key, _, group = part.key.partition(GROUP)
        others = groups[part.source] - {group}
        if others:
            taken = {name for other in others for name in other.split(GROUP)}
            own = [name for name in group.split(GROUP) if name not in taken]
            name = own[0] if own else ",".join(group.split(GROUP))[:MAX_GROUP_NAME]
            part.key = ":".join(filter(None, (name, part.key)))


def _planned(
    survey: Survey, about: ImportAttributes, refused: list[Refused]
) -> dict[tuple[str, str], tuple[_Part, ForeignStream]]:
    """The streams by source and key; those of the mapping come first, up to the limit."""
    _name_groups(survey.parts.values())
    several = Counter(source for source, _ in survey.parts)
    for part in survey.parts.values():
        if several[part.source] == 1:
            part.key = ""
    labels = {part.label: key for key, part in survey.parts.items()}
    names = stream_names(list(labels), about.mapping)
    found: dict[tuple[str, str], tuple[_Part, ForeignStream]] = {}
    for label in names:
        part = survey.parts[labels[label]]
        if len(found) >= MAX_STREAMS:
            reason = f"more than {MAX_STREAMS} streams; --map those that you want"
            refused.append(Refused(label, reason, part.schema, len(part.times)))
            continue
        try:
            descriptor = part.plan(names[label], about)
        except (InvalidInputError, LimitExceededError) as error:
            if names[label] in about.mapping:
                raise InvalidInputError(f"--map {names[label]}={label}: {error.message}") from error
            refused.append(Refused(label, error.message, part.schema, len(part.times)))
            continue
        form = part.form
        stream = ForeignStream(descriptor, label, (), form.as_numbers, form.notes)
        found[labels[label]] = (part, stream)
        refused += part.misfits()
    return found


def _calibration(
    survey: Survey, streams: Iterable[ForeignStream], refused: list[Refused]
) -> dict[str, np.ndarray]:
    """Matrices of the cameras that calibrations belong to (`_seen_by`)."""
    images = [one for one in streams if one.descriptor.kind == "image"]
    made: dict[str, np.ndarray] = {}
    for source, (model, count) in survey.cameras.items():
        near = _seen_by(source, model, images, list(survey.cameras))
        near = [one for one in near if one.descriptor.shape[:2] == model.size_px]
        if not near:
            place = (
                f"in frame {model.frame!r} or beside" if model.frame is not None else "at or below"
            )
            reason = f"no images of {model.size_px} pixels {place} it"
            refused.append(Refused(source, reason, "calibration", count))
        for stream in near:
            camera = stream.descriptor.name.removeprefix("camera_")
            K, distortion = model.K, model.distortion
            if _RECTIFIED.search(stream.source):
                if model.K_rectified is None:
                    reason = f"no P, and the images of {stream.source!r} are rectified"
                    refused.append(Refused(source, reason, "calibration", count))
                    continue
                K, distortion = model.K_rectified, (0.0,) * NUM_DISTORTION
            made[f"K_{camera}"] = np.array(K).reshape(3, 3)
            made[f"distortion_{camera}"] = np.array(distortion)[None]
            made[f"image_size_{camera}_px"] = np.array([model.size_px[::-1]], dtype=np.float64)
    return made


def _seen_by(
    source: str, model: CameraModel, images: list[ForeignStream], calibrations: list[str]
) -> list[ForeignStream]:
    """Images in the calibration's frame; else at or below its name; else the ones beside it.

    Those of Rerun, without a frame, are of what is at or below their entity only.
    """
    folder = source.rpartition("/")[0]
    if in_frame := [one for one in images if model.frame and one.descriptor.frame == model.frame]:
        beside = [one for one in in_frame if f"{one.source}/".startswith(f"{folder}/")]
        return beside or in_frame
    if below := [one for one in images if f"{one.source}/".startswith(f"{source}/")]:
        return below
    num_beside = sum(one.rpartition("/")[0] == folder for one in calibrations)
    if model.frame is None or (len(calibrations) > 1 and (not folder or num_beside > 1)):
        return []
    return [one for one in images if one.source.startswith(f"{folder}/")]


def import_readings(
    path: Path,
    store: EpisodeStore,
    about: ImportAttributes,
    read: Callable[[Survey | None], Iterator[Reading]],
    *,
    form: str,
) -> ImportReport:
    """Import a file whose records `read` yields: first for a survey, then again without one.

    `form` names the format.

    Raises:
        CorruptDataError: the file is damaged or truncated; nothing is imported.
        InvalidInputError: no stream can be imported, or the mapping does not fit.
        UnknownNameError: a mapping of a source that the file does not have.
        ConflictError: the store has a recording of this id.
    """
    survey = Survey()
    try:
        for reading in read(survey):
            survey.observe(reading)
    except CorruptDataError as error:
        raise CorruptDataError(f"{error.message}; {survey.summary()}") from error
    refused = survey.refused()
    try:
        planned = _planned(survey, about, refused)
    except UnknownNameError as error:
        raise InvalidInputError(f"{path}: {error.message}") from error
    parts = {key: part for key, (part, _) in planned.items()}
    streams = [stream for _, stream in planned.values()]
    attributes = new_attributes(
        path,
        about,
        form=form,
        first_ns=survey.first_ns,
        calibration=_calibration(survey, streams, refused),
    )
    blocks = _blocks(parts, read(None), refused)
    return write_recording(store, attributes, streams, blocks=blocks, refused=refused)


def _blocks(
    parts: Mapping[tuple[str, str], _Part], readings: Iterator[Reading], refused: list[Refused]
) -> Iterator[tuple[str, Block]]:
    """Second pass: blocks of all streams, and at the end what was lost."""
    for reading in readings:
        for item in reading.items:
            part = parts.get((reading.source, item.key))
            if part is not None:
                for block in part.take(reading, item):
                    yield part.name, block
    for part in parts.values():
        for block in part.finish():
            yield part.name, block
        refused.extend(part.losses())
