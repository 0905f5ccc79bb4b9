"""Import of the episodes of any LeRobot dataset as recordings, with the streams that it has."""

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dextouch.bridges.foreign import (
    MAX_ID,
    ForeignStream,
    ImportAttributes,
    ImportChoices,
    ImportReport,
    Refused,
    file_sha256,
    new_attributes,
    recording_id_of,
    stream_names,
    write_recording,
)
from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.feature_streams import (
    COUNTERS,
    TASK_INDEX,
    Frames,
    feature_streams,
    text_stream,
)
from dextouch.bridges.lerobot.source import EpisodeEntry, LeRobotFolder, whole_text
from dextouch.episodes import EpisodeStore
from dextouch.errors import CorruptDataError, InvalidInputError
from dextouch.schemas import MAX_INSTRUCTION, Domain, LineageEntry, Matrix, RecordingAttributes
from dextouch.streams import HEAD_CAMERA

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
    """What writes an episode of a dataset as a recording; raises as `import_lerobot`.

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
        raise CorruptDataError(f"{where}: timestamp is not a time in seconds")
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
    if info.total_frames not in {None, num_frames}:
        problems.append(
            f"info.json says {info.total_frames} frames, the episodes have {num_frames}"
        )
    if info.total_tasks not in {None, len(source.tasks)}:
        problems.append(f"info.json says {info.total_tasks} tasks, there are {len(source.tasks)}")
    told = {text for entry in source.episodes for text in entry.tasks}
    if source.tasks and not told <= {*source.tasks.values()}:
        unknown = sorted(told - {*source.tasks.values()})[:5]
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
    if TASK_INDEX in rows.column_names and source.tasks:
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
