"""Features of a LeRobot dataset as streams of one episode: numbers, text, images and video."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import compress, islice
from typing import Final

import numpy as np
from jaxtyping import Int64
from pydantic import ValidationError

from dextouch.bridges.exporting import BLOCK_IMAGES, Block
from dextouch.bridges.foreign import ForeignStream, ImageUnit, Refused
from dextouch.bridges.foreign_images import compressed_form, decode_png
from dextouch.bridges.lerobot.source import (
    EpisodeEntry,
    FeatureInfo,
    LeRobotFolder,
    whole_text,
)
from dextouch.bridges.lerobot.video import read_images, read_units
from dextouch.episodes import GOP_IMAGES, is_keyframe
from dextouch.errors import CorruptDataError
from dextouch.images import decode_jpeg
from dextouch.schemas import first_problems
from dextouch.streams import (
    ENCODED_UNITS,
    JPEG_UNIT,
    NO_DEVICE_TIME,
    StreamDescriptor,
    StreamKind,
    encoded_values,
)

# What counts frames; the times of a stream and the recording's id say it.
COUNTERS: Final = ("timestamp", "frame_index", "episode_index", "index")
TASK_INDEX: Final = "task_index"
UNKNOWN_UNIT: Final = "unknown"
TEXT_UNIT: Final = "utf8"
MAX_TEXT_BYTES: Final = 1 << 16
# Of all texts of an episode, padded to the longest.
MAX_TEXTS_BYTES: Final = 1 << 30
TEXT_TYPES: Final = ("string", "large_string", "language")
_ROWS_AT_ONCE = 1024
# Types of columns and those of streams, which hold all of their values; uint64 is checked.
_STORED = {
    **{name: name for name in ("uint8", "uint16", "int64", "float32", "float64")},
    **dict.fromkeys(("int8", "int16", "int32", "uint32", "uint64"), "int64"),
    "bool": "uint8",
    "float16": "float32",
}


@dataclass(frozen=True)
class Frames:
    """Frames of one episode: when they were, their nominal rate, and what holds them."""

    source: LeRobotFolder
    entry: EpisodeEntry
    t_ns: Int64[np.ndarray, " n"]
    rate_hz: float

    def feature(self, key: str) -> FeatureInfo:
        """A feature's description."""
        return self.source.info.features[key]


def feature_streams(
    frames: Frames, names: Mapping[str, str], unit: ImageUnit | None
) -> tuple[list[ForeignStream], list[Refused]]:
    """Streams of the named features (stream names by feature), and what cannot become one.

    `unit` is that of images; None keeps them as near to what they are as the store can: JPEG
    images and fitting H.264 byte for byte, PNG images as pixels, other video as H.264.

    Raises as `LeRobotFolder.numbers` for damaged files.
    """
    streams, refused = [], []
    for key, name in names.items():
        made = _stream(frames, key, name, unit)
        if isinstance(made, ForeignStream):
            streams.append(made)
        else:
            dtype = frames.feature(key).dtype
            refused.append(Refused(key, made, dtype, frames.entry.length))
    return streams, refused


def _stream(frames: Frames, key: str, name: str, unit: ImageUnit | None) -> ForeignStream | str:
    feature = frames.feature(key)
    try:
        if feature.is_camera():
            return camera_stream(frames, key, name, frames.t_ns, unit)
        if feature.dtype in TEXT_TYPES:
            return text_stream(frames, key, name, frames.source.texts(frames.entry, key))
        return _number_stream(frames, key, name)
    except ValidationError as error:
        return first_problems(error)


def _descriptor(frames: Frames, name: str, kind: StreamKind, **fields: object) -> StreamDescriptor:
    known = {"name": name, "kind": kind, "nominal_rate_hz": frames.rate_hz}
    return StreamDescriptor.model_validate(known | fields)


def _block(t_ns: np.ndarray, values: np.ndarray) -> Block:
    nothing = np.full(len(t_ns), NO_DEVICE_TIME, dtype=np.int64)
    return Block(t_ns, nothing, nothing, values)


def _blocks(t_ns: np.ndarray, values: np.ndarray) -> Iterator[Block]:
    for start in range(0, len(t_ns), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        yield _block(t_ns[part], values[part])


def _number_stream(frames: Frames, key: str, name: str) -> ForeignStream | str:
    values = frames.source.numbers(frames.entry, key)
    got, feature = values.dtype.name, frames.feature(key)
    if got == "uint64" and values.size and int(values.max()) > np.iinfo(np.int64).max:
        return "holds numbers above 2^63, which no stream can"
    if got not in _STORED:
        return f"holds {got}, expected numbers of {', '.join(_STORED)}"
    stored = _STORED[got]
    values = values.reshape(len(values), *(values.shape[1:] or (1,))).astype(stored, copy=False)
    is_state = key.startswith(("action", "observation.state"))
    notes: tuple[str, ...] = () if got == stored else (f"{got} as {stored}",)
    descriptor = _descriptor(
        frames,
        name,
        "robot_state" if is_state else "scalar",
        shape=values.shape[1:],
        dtype=stored,
        unit="bool" if got == "bool" else UNKNOWN_UNIT,
        names=feature.component_names(),
    )
    if feature.names and not descriptor.names and feature.shape != (1,):
        notes += (f"names {json.dumps(feature.names)[:200]} are not one for each number",)
    return ForeignStream(descriptor, key, _blocks(frames.t_ns, values), notes=notes)


def text_stream(
    frames: Frames, key: str, name: str, values: Iterable[object]
) -> ForeignStream | str:
    """A stream of text, one for each frame, as UTF-8 padded with zeros; lists become JSON."""
    plain = ("" if one is None else one for one in values)
    texts = [
        whole_text(one if isinstance(one, str) else json.dumps(one, default=str)).encode()
        for one in plain
    ]
    width = max(1, *map(len, texts)) if texts else 1
    if width > MAX_TEXT_BYTES:
        return f"holds a text of {width} bytes, expected at most {MAX_TEXT_BYTES}"
    if width * len(texts) > MAX_TEXTS_BYTES:
        return (
            f"holds a text of {width} bytes, to which {len(texts)} would be padded; expected at "
            f"most {MAX_TEXTS_BYTES} bytes in all"
        )
    descriptor = _descriptor(frames, name, "scalar", shape=(width,), dtype="uint8", unit=TEXT_UNIT)

    def blocks() -> Iterator[Block]:
        for start in range(0, len(texts), _ROWS_AT_ONCE):
            some = texts[start : start + _ROWS_AT_ONCE]
            padded = np.array(some, dtype=f"S{width}").view(np.uint8).reshape(len(some), width)
            yield _block(frames.t_ns[start : start + len(some)], padded)

    hidden = sum(one.endswith(b"\0") for one in texts)
    notes = (f"{hidden} texts end in zeros, which look like the padding",) if hidden else ()
    about = "text as UTF-8, padded with zeros"
    return ForeignStream(descriptor, key, blocks(), about, notes)


def camera_stream(
    frames: Frames, key: str, name: str, stamps_ns: np.ndarray, unit: ImageUnit | None
) -> ForeignStream | str:
    """A stream of a video or image feature; a stamp that comes twice is one image.

    Returns why there is none for what no stream can hold.
    """
    feature = frames.feature(key)
    if feature.is_depth():
        return "depth maps in a lossy scale of LeRobot's own are not decoded"
    if feature.dtype == "image":
        return _image_stream(frames, key, name, stamps_ns, unit)
    shape = feature.numbers()
    if len(shape) != 3 or shape[2] not in {1, 3} or min(shape) < 1:
        return f"is a video of shape {list(feature.shape)}, expected [h, w, 3]"
    stored = unit or ("rgb8" if shape[0] % 2 or shape[1] % 2 else "h264")
    span = frames.source.span(frames.entry, key)
    descriptor = _descriptor(frames, name, "image", shape=span.shape, dtype="uint8", unit=stored)
    fresh = np.diff(stamps_ns, prepend=stamps_ns[0] - 1) > 0

    def blocks() -> Iterator[Block]:
        units = read_units(span) if stored == "h264" and fresh.all() else None
        # The store's video is in closed groups of pictures.
        if units and all(is_keyframe(u) == (k % GOP_IMAGES == 0) for k, u in enumerate(units)):
            yield _block(stamps_ns, encoded_values(units))
        else:
            notes.append(converted_note("", stored))
            yield from _image_blocks(read_images(span), stamps_ns, fresh)

    notes: list[str] = []
    return ForeignStream(descriptor, key, blocks(), notes=notes)


def _image_blocks(
    images: Iterator[np.ndarray | bytes], stamps_ns: np.ndarray, fresh: np.ndarray
) -> Iterator[Block]:
    """Blocks of the images (pixels or bytes) with fresh stamps; the others are read as well."""
    kept = compress(images, fresh)
    stamps = stamps_ns[fresh]
    for start in range(0, len(stamps), BLOCK_IMAGES):
        some = list(islice(kept, BLOCK_IMAGES))
        encoded = [image for image in some if isinstance(image, bytes)]
        values = encoded_values(encoded) if encoded else np.stack(some)
        yield _block(stamps[start : start + BLOCK_IMAGES], values)
    # Exhausts the reader, so that a file that is too short is refused.
    for _ in kept:
        pass


def _image_stream(
    frames: Frames, key: str, name: str, stamps_ns: np.ndarray, unit: ImageUnit | None
) -> ForeignStream | str:
    """Of images one by one, which have the form of the first of them."""
    read = partial(frames.source.images, frames.entry, key)
    form, dtype, shape, _ = compressed_form(next(read()))
    declared = frames.feature(key).numbers()
    if shape[:2] != declared[:2]:
        raise CorruptDataError(
            f"{frames.source.folder}: episode {frames.entry.index}: {key!r} has images of "
            f"{list(shape)}, info.json declares {list(declared)}"
        )
    stored = form if unit is None or len(shape) < 3 else unit
    keeps = form == stored and stored in ENCODED_UNITS
    descriptor = _descriptor(frames, name, "image", shape=shape, dtype=dtype, unit=stored)
    fresh = np.diff(stamps_ns, prepend=stamps_ns[0] - 1) > 0
    where = f"{frames.source.folder}: episode {frames.entry.index}: {key!r}"

    def blocks() -> Iterator[Block]:
        encoded = _same_form(read(), (form, dtype, shape), where)
        decode = decode_jpeg if form == JPEG_UNIT else partial(decode_png, shape=shape, dtype=dtype)
        yield from _image_blocks(encoded if keeps else map(decode, encoded), stamps_ns, fresh)

    notes = () if keeps else (converted_note("PNG" if form != JPEG_UNIT else "JPEG", stored),)
    return ForeignStream(descriptor, key, blocks(), notes=notes)


def converted_note(what: str, stored: str) -> str:
    """What is said of images that are not stored as they were."""
    encoded = f", encoded as {stored}" if stored in ENCODED_UNITS else ""
    return f"{what} decoded{encoded}".strip()


def _same_form(
    images: Iterator[bytes], expected: tuple[str, str, tuple[int, ...]], where: str
) -> Iterator[bytes]:
    for index, data in enumerate(images):
        form, dtype, shape, plain = compressed_form(data)
        if (form, dtype, shape) != expected:
            raise CorruptDataError(
                f"{where}: image {index} is {form} {list(shape)}, image 0 {expected[0]} "
                f"{list(expected[2])}; expected images of one form in an episode"
            )
        yield plain
