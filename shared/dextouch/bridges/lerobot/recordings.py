"""Import of the episodes of any LeRobot dataset as recordings, with a stream for each feature."""

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import compress, islice
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Int64
from pydantic import ValidationError

from dextouch.bridges.export_files import BLOCK_IMAGES, Block
from dextouch.bridges.import_images import compressed_form, decode_png
from dextouch.bridges.import_recording import (
    MAX_ID,
    ForeignStream,
    ImageUnit,
    ImportAttributes,
    ImportChoices,
    ImportReport,
    Refused,
    file_sha256,
    new_attributes,
    recording_id_of,
    stream_names,
    whole_text,
    write_recording,
)
from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.source import EpisodeEntry, FeatureInfo, LeRobotFolder
from dextouch.bridges.lerobot.video import read_images, read_units
from dextouch.episodes import GOP_IMAGES, EpisodeStore, is_keyframe
from dextouch.errors import CorruptDataError, InvalidInputError
from dextouch.images import decode_jpeg
from dextouch.schemas import (
    MAX_INSTRUCTION,
    Domain,
    LineageEntry,
    Matrix,
    RecordingAttributes,
    first_problems,
)
from dextouch.streams import (
    ENCODED_UNITS,
    HEAD_CAMERA,
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
    where = f"{frames.source.folder}: episode {frames.entry.index}: {key!r}"
    if shape[:2] != declared[:2]:
        raise CorruptDataError(
            f"{where} has images of {list(shape)}, info.json declares {list(declared)}"
        )
    stored = form if unit is None or len(shape) < 3 else unit
    keeps = form == stored and stored in ENCODED_UNITS
    descriptor = _descriptor(frames, name, "image", shape=shape, dtype=dtype, unit=stored)
    fresh = np.diff(stamps_ns, prepend=stamps_ns[0] - 1) > 0

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


# Of the frames' times from their nominal ones, as a share of a frame: chosen, a tenth shows a rate
# that is wrong by one per cent after ten frames.
LARGEST_DRIFT = 0.1
MAX_FPS = 1000


@dataclass(frozen=True)
class ImportOptions(ImportChoices):
    """Options of an import: information that the dataset itself lacks.

    `mapping`: our name → the dataset's feature, for features under other names: `action`, `state`,
    `tactile` and cameras (`camera_head`, `camera_wrist_left`, …); of recordings the name of any
    stream. `images`: None for the unit nearest to what they are. Only for datasets of other origin:
    `domain`, `task`, `instruction`, `K_head` in pixels, and `fps`, the rate instead of that and the
    timestamps of the dataset.
    """

    domain: Domain = "robot"
    K_head: Matrix | None = None
    fps: float | None = None


def recordings_importer(
    source: LeRobotFolder, store: EpisodeStore, options: ImportOptions
) -> Callable[[EpisodeEntry], ImportReport]:
    """What writes an episode of a dataset as a recording; raises as `import_dataset`.

    Its report lists nothing as imported if the store has that recording of the same files already.
    """
    names = _names(source, options.mapping)
    if options.fps is not None and not 0 < options.fps <= MAX_FPS:
        raise InvalidInputError(f"fps: got {options.fps}, expected above 0 and at most {MAX_FPS}")
    if options.K_head is not None and HEAD_CAMERA not in names.values():
        cameras = [key for key, one in source.info.features.items() if one.is_camera()]
        raise InvalidInputError(
            f"camera matrix (--k-head): no feature is {HEAD_CAMERA!r}; name one of {cameras} by "
            f"--map {HEAD_CAMERA}=FEATURE"
        )
    about = dataset_contradictions(source)
    digests: dict[Path, str] = {}

    def write(entry: EpisodeEntry) -> ImportReport:
        attributes = _attributes(source, entry, options, digests)
        if _is_present(store, attributes):
            return ImportReport(attributes.recording_id, source.folder.name)
        report = _import_one(source, store, entry, names, options, attributes)
        report.contradictions[:0] = about
        return report

    return write


def _is_present(store: EpisodeStore, attributes: RecordingAttributes) -> bool:
    """Whether the store has the recording, of files with the same content."""
    name, source = attributes.recording_id, attributes.imported_from
    if not store.exists(name, kind="recording"):
        return False
    known = store.recording(name).attributes.imported_from
    return known is not None and source is not None and known.sha256 == source.sha256


def _names(source: LeRobotFolder, mapping: Mapping[str, str]) -> dict[str, str]:
    """Names of streams by feature; cameras with one of our names keep it."""
    for name, key in mapping.items():
        feature = source.info.features[key]
        if name.startswith("camera_") and not feature.is_camera():
            raise InvalidInputError(
                f"--map {name}={key}: is {feature.dtype} {list(feature.shape)}, expected images; "
                "names of cameras are for images"
            )
    keys = [key for key in source.info.features if key not in {*COUNTERS, TASK_INDEX}]
    own = {
        key.removeprefix(layout.IMAGES): key
        for key in keys
        if key.startswith(f"{layout.IMAGES}camera_") and key not in mapping.values()
    }
    known = {name: key for name, key in own.items() if name not in mapping and name.islower()}
    return stream_names(keys, known | dict(mapping))


def frame_times(
    source: LeRobotFolder, entry: EpisodeEntry, fps: float | None
) -> tuple[np.ndarray, list[str]]:
    """Times of an episode's frames in ns, and what in them contradicts the rate.

    They are those of `timestamp`, seconds from the episode's start; where these are the nearest
    float32 of `frame_index / fps`, that is taken, so that times are not rounded to microseconds.
    With `fps` they are `frame_index / fps`.

    Raises CorruptDataError for timestamps that are not finite, or go back.
    """
    count = np.arange(entry.length)
    if fps is not None:
        return np.rint(count * (1e9 / fps)).astype(np.int64), []
    where = f"{source.folder}: episode {entry.index}"
    nominal_s = count / source.info.fps
    if "timestamp" not in source.info.features:
        return np.rint(nominal_s * 1e9).astype(np.int64), [
            f"episode {entry.index} has no timestamps"
        ]
    said_s = source.numbers(entry, "timestamp").astype(np.float64)
    if not np.isfinite(said_s).all() or np.abs(said_s).max() > 1e9:
        raise CorruptDataError(
            f"{where}: timestamp goes to {np.abs(said_s).max():g}, expected seconds; see --fps RATE"
        )
    if (np.diff(said_s) <= 0).any():
        raise CorruptDataError(
            f"{where}: timestamp does not rise from frame to frame; --fps RATE takes the frames' "
            "numbers instead"
        )
    drift_s = np.abs(said_s - said_s[0] - nominal_s)
    if (drift_s <= np.spacing(said_s.astype(np.float32))).all() and said_s[0] == 0:
        return np.rint(nominal_s * 1e9).astype(np.int64), []
    problems = []
    if drift_s.max() * source.info.fps > LARGEST_DRIFT:
        rate_hz = (entry.length - 1) / (said_s[-1] - said_s[0])
        problems.append(
            f"episode {entry.index}: its timestamps have {rate_hz:.6g} Hz on average and are up to "
            f"{drift_s.max() * 1e3:.4g} ms from those of the {source.info.fps:g} Hz of info.json; "
            "the timestamps are taken"
        )
    return np.rint(said_s * 1e9).astype(np.int64), problems


def dataset_contradictions(source: LeRobotFolder) -> list[str]:
    """What `meta/` says of a dataset and its files do not hold, or say otherwise."""
    info, problems = source.info, []
    num_frames = sum(entry.length for entry in source.episodes)
    if source.episodes and (last := source.episodes[-1].index) >= len(source.episodes):
        problems.append(f"of the episodes 0 … {last} there are {len(source.episodes)}")
    if info.total_frames not in {None, num_frames}:
        problems.append(
            f"info.json says {info.total_frames} frames, the episodes have {num_frames}"
        )
    if info.total_tasks not in {None, len(source.tasks)}:
        problems.append(f"info.json says {info.total_tasks} tasks, there are {len(source.tasks)}")
    named_tasks = {text for entry in source.episodes for text in entry.tasks}
    if source.tasks and not named_tasks <= {*source.tasks.values()}:
        unknown = sorted(named_tasks - {*source.tasks.values()})[:5]
        problems.append(f"tasks of episodes that the list of tasks lacks: {unknown}")
    for key, feature in info.features.items():
        about = feature.about_video()
        size = (about.get("video.height"), about.get("video.width"))
        if feature.is_camera() and None not in size and size != feature.numbers()[:2]:
            problems.append(f"{key}: shape {list(feature.shape)}, but its video is of {list(size)}")
        fps = about.get("video.fps", info.fps)
        if fps != info.fps:
            problems.append(f"{key}: video of {fps} Hz in a dataset of {info.fps:g} Hz")
    return problems


def _episode_contradictions(source: LeRobotFolder, entry: EpisodeEntry) -> Iterator[str]:
    rows = source.rows(entry)
    if TASK_INDEX in source.info.features and source.tasks:
        numbers = np.unique(source.numbers(entry, TASK_INDEX)).tolist()
        texts = {source.tasks.get(number, f"task {number}") for number in numbers}
        if texts != {*entry.tasks}:
            yield (
                f"episode {entry.index}: its frames are of the tasks {sorted(texts)}, "
                f"its description says {sorted(entry.tasks)}"
            )
    for key, feature in source.info.features.items():
        if key in rows.column_names and feature.dtype in {"float32", "float64", "int64", "bool"}:
            got = source.numbers(entry, key).dtype.name
            if got != feature.dtype:
                yield f"episode {entry.index}: {key} is {got}, info.json says {feature.dtype}"


def _import_one(
    source: LeRobotFolder,
    store: EpisodeStore,
    entry: EpisodeEntry,
    names: Mapping[str, str],
    options: ImportOptions,
    attributes: RecordingAttributes,
) -> ImportReport:
    t_ns, problems = frame_times(source, entry, options.fps)
    frames = Frames(source, entry, t_ns, options.fps or source.info.fps)
    streams, refused = feature_streams(frames, names, options.images)
    streams += _task_stream(frames, names.values())
    refused += [
        Refused(key, "info.json does not declare this column", num_samples=entry.length)
        for key in source.rows(entry).column_names
        if key not in source.info.features
    ]
    report = write_recording(store, attributes, streams, refused=refused)
    report.contradictions += [*problems, *_episode_contradictions(source, entry)]
    return report


def _task_stream(frames: Frames, taken: Collection[str]) -> list[ForeignStream]:
    """The task of each frame, where an episode has several."""
    source, entry = frames.source, frames.entry
    if TASK_INDEX not in source.info.features:
        return []
    numbers = source.numbers(entry, TASK_INDEX).tolist()
    if len(set(numbers)) < 2:
        return []
    name = next(n for n in ("task", "task_of_frame", "lerobot_task_of_frame") if n not in taken)
    texts = [source.tasks.get(number, f"task {number}") for number in numbers]
    made = text_stream(frames, TASK_INDEX, name, texts)
    return [made] if isinstance(made, ForeignStream) else []


def _files(source: LeRobotFolder, entry: EpisodeEntry) -> list[Path]:
    """The files that hold an episode's frames, in the order of the features."""
    videos = [key for key, feature in source.info.features.items() if feature.dtype == "video"]
    files = [source.data_file(entry), *(source.span(entry, key).path for key in videos)]
    return [path for path in dict.fromkeys(files) if path.is_file()]


def dataset_id(source: LeRobotFolder, entry: EpisodeEntry, length: int = MAX_ID) -> str:
    """Id of an episode: that of a recording of the folder, and its number."""
    number, plain = f"-{entry.index:06d}", source.folder.resolve().name.replace(".", "-")
    return recording_id_of(Path(plain))[: max(1, length - len(number))] + number


def _attributes(
    source: LeRobotFolder, entry: EpisodeEntry, options: ImportOptions, digests: dict[Path, str]
) -> RecordingAttributes:
    root = source.folder.resolve()
    lines = []
    for path in _files(source, entry):
        if path not in digests:
            digests[path] = file_sha256(path)
        lines.append((path.relative_to(root).as_posix(), digests[path]))
    text = "".join(f"{digest}  {name}\n" for name, digest in lines)
    task = options.task or entry.task or "unknown"
    about = ImportAttributes(
        id_prefix=options.id_prefix,
        task=task[:128],
        instruction=(options.instruction or " / ".join(entry.tasks))[:MAX_INSTRUCTION],
        domain=options.domain,
        station=whole_text(source.info.robot_type or "lerobot")[:128],
    )
    attributes = new_attributes(
        root,
        about,
        form=f"lerobot {source.info.codebase_version}",
        calibration={} if options.K_head is None else {"K_head": np.array(options.K_head)},
        sha256=hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest(),
    )
    name = dataset_id(source, entry, MAX_ID - len(options.id_prefix))
    return attributes.model_copy(
        update={
            "recording_id": recording_id_of(Path(name), options.id_prefix),
            "lineage": tuple(
                LineageEntry(
                    kind="recording", id=whole_text(f"lerobot:{root.name}/{name}"), sha256=digest
                )
                for name, digest in lines
            ),
        }
    )
