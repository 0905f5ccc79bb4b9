"""The LeRobotDataset v3.0 layout: features, paths, and an episode as rows with their statistics."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Bool, Float32, Int64, Shaped, UInt8
from pydantic import Field

from dextouch.episodes import GOP_IMAGES, EpisodeReader, mean_over_ranges, step_ranges
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError
from dextouch.frozen_model import FrozenModel
from dextouch.geometry import bracket, interpolate_linear, interpolate_poses
from dextouch.hands.actions import (
    ACTION_DIM,
    AnchorPoses,
    HandTrajectory,
    action_names,
    actions_from_poses,
    poses_from_actions,
)
from dextouch.schemas import ActionKind, EpisodeAttributes
from dextouch.streams import H264_UNIT
from dextouch.tactile.layout import NUM_TAXELS, SIDES

CODEBASE_VERSION: Final = "v3.0"
INFO_FILE: Final = "meta/info.json"
STATS_FILE: Final = "meta/stats.json"
TASKS_FILE: Final = "meta/tasks.parquet"
# Of v2, which has one JSON object on each line.
TASKS_LINES: Final = "meta/tasks.jsonl"
EPISODES_LINES: Final = "meta/episodes.jsonl"
CARD_FILE: Final = "README.md"
EPISODES_PATH: Final = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
SIDECAR_PATH: Final = "meta/dextouch/episode-{episode_index:06d}.json"
CHUNK_FILES: Final = 1000
DATA_FILE_MB: Final = 100
VIDEO_FILE_MB: Final = 200

ACTION: Final = "action"
STATE: Final = "observation.state"
TACTILE: Final = "observation.tactile"
IMAGES: Final = "observation.images."
# Outside "observation" and "action": LeRobot's policies take nothing from here by themselves.
MEASURED: Final = "dextouch.action_measured"
VALID: Final = "dextouch.tactile_valid"
STAMP: Final = "dextouch.t_ref_ns"
IMAGE_DT: Final = "dextouch.image_dt_ns"
# With native rates: the samples since the frame before, at most as many as the first axis has.
SAMPLES: Final = "observation.tactile_samples"
SAMPLES_DT: Final = "dextouch.tactile_samples_dt_ns"
SAMPLES_COUNT: Final = "dextouch.tactile_samples_count"
# Of features, for the dataset's card.
MEANING: Final = {
    STATE: "measured wrist and head poses in the world, joints in rad",
    TACTILE: "kPa, left and right hand, mean of the samples since the frame before",
    ACTION: "as the state, but relative to the measured poses of the episode's first step",
    MEASURED: "the measured action, where `action` is the commanded one",
    VALID: "whether there was a touch sample, left and right",
    STAMP: "time of the frame in ns on the episode's clock",
    IMAGE_DT: "time of each camera's image minus that of the frame, ns",
    SAMPLES: "kPa of each touch sample since the frame before, oldest first, then zeros",
    SAMPLES_DT: "time of each of these samples minus that of the frame, ns; zeros after the last",
    SAMPLES_COUNT: "number of touch samples since the frame before, left and right",
    "timestamp": "seconds: frame_index / fps",
}

Feature = dict[str, Any]
Features = dict[str, Feature]
Grid = Literal["model", "camera", "uniform"]

# Maximum number of images per episode, and the side length they are subsampled to.
SAMPLED_IMAGES: Final = 100
SAMPLED_SIDE_PX: Final = 320
QUANTILES: Final = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Statistics = dict[str, Shaped[np.ndarray, "..."]]
WORLD = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))

_TEMPLATE = re.compile(r"([^{}]|\{[a-z_]+(:0\d{1,2}d)?\})*")


class Sidecar(FrozenModel):
    """JSON file of an episode with the DexTouch attributes that LeRobot has no field for.

    `grid` and `action_kind` say how its frames were made, `cameras` whether a camera's video was
    `remuxed` (bytes unchanged) or `encoded` again.
    """

    sidecar_version: Literal[1] = 1
    episode_index: int = Field(ge=0)
    content_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    grid: Grid
    action_kind: ActionKind
    cameras: dict[str, Literal["remuxed", "encoded"]]
    attributes: EpisodeAttributes


def _feature(dtype: str, shape: Sequence[int], names: list[str] | None = None) -> Feature:
    return {"dtype": dtype, "shape": list(shape), "names": names}


def _video_feature(shape: Sequence[int], fps: int) -> Feature:
    info = {
        "video.height": shape[0],
        "video.width": shape[1],
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
        "is_depth_map": False,
    }
    return {**_feature("video", shape, ["height", "width", "channels"]), "info": info}


def dataset_features(
    cameras: Mapping[str, Sequence[int]],
    fps: int,
    *,
    has_measured: bool,
    num_taxels: int = NUM_TAXELS,
    num_samples: int = 0,
) -> Features:
    """Every feature of an export, by name, for cameras with images of shape [height, width, 3].

    With `has_measured` actions are commanded ones, and measured ones are stored beside them; with
    `num_samples` there are as many touch samples in each frame.
    """
    names = action_names()
    pose, number = _feature("float32", [len(names)], names), _feature("int64", [1])
    features = {IMAGES + name: _video_feature(shape, fps) for name, shape in cameras.items()}
    features[STATE] = pose
    features[TACTILE] = _feature("float32", [2, num_taxels], ["hand", "taxel_kpa"])
    if num_samples:
        features[SAMPLES] = _feature(
            "float32", [num_samples, 2, num_taxels], ["sample", "hand", "taxel_kpa"]
        )
        features[SAMPLES_DT] = _feature("int64", [num_samples, 2], ["sample", "hand"])
        features[SAMPLES_COUNT] = _feature("int64", [2], list(SIDES))
    features[ACTION] = pose
    if has_measured:
        features[MEASURED] = pose
    features |= {VALID: _feature("bool", [2], list(SIDES)), STAMP: number}
    if cameras:
        features[IMAGE_DT] = _feature("int64", [len(cameras)], list(cameras))
    features["timestamp"] = _feature("float32", [1])
    counters = ("frame_index", "episode_index", "index", "task_index")
    return features | dict.fromkeys(counters, number)


def file_place(number: int) -> tuple[int, int]:
    """Chunk and file index of the n-th file of a kind."""
    return divmod(number, CHUNK_FILES)


def fill_path(template: str, **values: int | str) -> str:
    """Fill in the plain fields of a path template; raises InvalidInputError for any other brace."""
    with suppress(KeyError, ValueError):
        if _TEMPLATE.fullmatch(template):
            return template.format(**values)
    raise InvalidInputError(
        f"path template {template!r}: expected fields like {{chunk_index:03d}} only, "
        f"of {sorted(values)}"
    )


def numbered_path(folder: Path, template: str, number: int, **values: str) -> Path:
    """Path of the n-th file of a kind; its folder is created."""
    chunk, file = file_place(number)
    path = folder / template.format(chunk_index=chunk, file_index=file, **values)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def confined(folder: Path, relative: str) -> Path:
    """A path below `folder`, following links; raises CorruptDataError if it leads out.

    Links of a snapshot in the cache of the Hub may lead to the blobs of its repository.
    """
    root = folder.resolve()
    if "\0" in relative:
        raise CorruptDataError(f"{folder}: got a path with a zero byte")
    path = (root / relative).resolve()
    if path.is_relative_to(root):
        return path
    if root.parent.name == "snapshots" and path.parent == root.parents[1] / "blobs":
        return root / relative
    raise CorruptDataError(f"{folder}: path {relative!r} leads out of the dataset; refused")


@dataclass(frozen=True)
class EpisodeFrames:
    """One row per frame; `image_indices` gives the stored image of each camera in a frame.

    `columns` [n, …] are those of `dataset_features`: STATE float32 [67] holds absolute
    measured poses and joints; ACTION and MEASURED float32 [67] are relative to the measured poses
    of the episode's step 0; TACTILE float32 [2, taxels] in kPa, VALID bool [2], STAMP int64 and
    IMAGE_DT int64 [cameras], the image's stamp minus the frame's, in ns.
    """

    grid: Grid
    action_kind: ActionKind
    columns: dict[str, np.ndarray]
    image_indices: dict[str, Int64[np.ndarray, " n"]]

    def __len__(self) -> int:
        return len(self.columns[STAMP])


def frames_of(reader: EpisodeReader, cameras: Sequence[str], fps: int) -> EpisodeFrames:
    """The frames of an episode.

    On the model grid when `fps` is the model rate; at the first camera's own stamps when `fps` is
    its rate; otherwise evenly spaced from step 0. Images are the nearest ones that can be decoded,
    tactile values the mean since the frame before; off the model grid poses and joints are
    interpolated between its steps.

    Raises:
        InvalidInputError: an episode without steps or with fewer than one frame.
        NotFoundError: a camera without images.
    """
    steps = reader.read("action") if reader.num_steps else None
    if steps is None or steps.values.shape[1:] != (ACTION_DIM,):
        raise InvalidInputError(
            f"episode {reader.attributes.episode_id!r}: has no 'action' of {ACTION_DIM} numbers; "
            "export only episodes that are aligned"
        )
    grid, t_ns = _frame_times(reader, cameras, fps, steps.t_ref_ns)
    kind: ActionKind = "commanded" if "action_commanded" in reader.streams else "measured"
    measured = _at(reader, steps.values, steps.t_ref_ns, t_ns)
    action = measured
    if kind == "commanded":
        sent = reader.read("action_commanded")
        action = _at(reader, sent.values, sent.t_ref_ns, t_ns)
    state = actions_from_poses(
        poses_from_actions(measured, reader.attributes.anchor.to_poses()), WORLD
    )
    kpa, valid = _touch_means(reader, t_ns)
    indices, offsets_ns = {}, np.zeros((len(t_ns), len(cameras)), dtype=np.int64)
    for column, camera in enumerate(cameras):
        stamps = _image_stamps(reader, camera)
        indices[camera] = reader.nearest_images(camera, t_ns)
        offsets_ns[:, column] = stamps[indices[camera]] - t_ns
    numbers = {STATE: state, ACTION: action, MEASURED: measured}
    columns = {name: values.astype(np.float32) for name, values in numbers.items()} | {
        TACTILE: kpa,
        VALID: valid,
        STAMP: t_ns,
        IMAGE_DT: offsets_ns,
    }
    return EpisodeFrames(grid, kind, columns, indices)


def _image_stamps(reader: EpisodeReader, camera: str) -> Int64[np.ndarray, " n"]:
    stamps = reader.stamps_ns(camera)
    if not len(stamps):
        raise NotFoundError(
            f"episode {reader.attributes.episode_id!r}: {camera!r} holds no image; "
            "leave that camera out"
        )
    return stamps


def _frame_times(
    reader: EpisodeReader, cameras: Sequence[str], fps: int, steps_ns: np.ndarray
) -> tuple[Grid, Int64[np.ndarray, " n"]]:
    if fps == reader.attributes.model_rate_hz:
        return "model", steps_ns.copy()
    half_ns = round(0.5e9 / fps)
    if cameras and fps == round(reader.streams[cameras[0]].nominal_rate_hz):
        damaged = reader.damaged_images(cameras[0])
        stamps = np.delete(_image_stamps(reader, cameras[0]), damaged)
        inside = (stamps >= steps_ns[0] - half_ns) & (stamps <= steps_ns[-1] + half_ns)
        if not inside.any():
            raise InvalidInputError(
                f"episode {reader.attributes.episode_id!r}: no image of {cameras[0]!r} lies "
                "within its steps"
            )
        return "camera", stamps[inside]
    count = int((int(steps_ns[-1] - steps_ns[0]) * fps) // 10**9) + 1
    return "uniform", steps_ns[0] + np.rint(np.arange(count) * (1e9 / fps)).astype(np.int64)


def _at(
    reader: EpisodeReader, actions: np.ndarray, steps_ns: np.ndarray, t_ns: np.ndarray
) -> np.ndarray:
    """Actions interpolated at other times; unchanged at the steps themselves."""
    if np.array_equal(steps_ns, t_ns) or len(steps_ns) < 2:
        return np.repeat(actions, len(t_ns), axis=0) if len(actions) != len(t_ns) else actions
    anchor = reader.attributes.anchor.to_poses()
    poses = poses_from_actions(actions, anchor)
    # A frame may lie up to half a frame outside the steps: it takes the pose of the nearest one.
    left, weight, _ = bracket(steps_ns, t_ns, max_gap_ns=int(np.diff(steps_ns).max()))
    between = HandTrajectory(
        interpolate_poses(poses.Ts_world_wrist_left, left, weight),
        interpolate_poses(poses.Ts_world_wrist_right, left, weight),
        interpolate_linear(poses.joints_left_rad, left, weight),
        interpolate_linear(poses.joints_right_rad, left, weight),
        interpolate_poses(poses.Ts_world_camera_head, left, weight),
    )
    return actions_from_poses(between, anchor)


def _touch_means(
    reader: EpisodeReader, t_ns: np.ndarray
) -> tuple[Float32[np.ndarray, "n 2 taxels"], Bool[np.ndarray, "n 2"]]:
    kpa = np.zeros((len(t_ns), 2, reader.tactile_layout.num_taxels), dtype=np.float32)
    valid = np.zeros((len(t_ns), 2), dtype=bool)
    for hand, name, ranges in _touch_ranges(reader, t_ns):
        kpa[:, hand], valid[:, hand] = mean_over_ranges(reader.read(name).values, ranges)
    return kpa, valid


def _touch_ranges(
    reader: EpisodeReader, t_ns: np.ndarray
) -> Iterator[tuple[int, str, Int64[np.ndarray, "n 2"]]]:
    """Number and stream of each hand with touch, and its samples since the frame before."""
    for hand, name in enumerate(f"tactile_{side}" for side in SIDES):
        if name in reader.streams:
            yield hand, name, step_ranges(reader.stamps_ns(name), t_ns, 0, len(t_ns))


def touch_counts(reader: EpisodeReader, t_ns: np.ndarray) -> Int64[np.ndarray, "n 2"]:
    """Number of touch samples of each hand in each frame, since the frame before."""
    counts = np.zeros((len(t_ns), 2), dtype=np.int64)
    for hand, _, ranges in _touch_ranges(reader, t_ns):
        counts[:, hand] = ranges[:, 1] - ranges[:, 0]
    return counts


def touch_samples(
    reader: EpisodeReader, t_ns: np.ndarray, num_samples: int
) -> dict[str, np.ndarray]:
    """Columns SAMPLES, SAMPLES_DT and SAMPLES_COUNT of frames at `t_ns`.

    Of more than `num_samples` since the frame before, the newest are kept; the count is of all.
    """
    shape = (len(t_ns), num_samples, 2)
    kpa = np.zeros((*shape, reader.tactile_layout.num_taxels), dtype=np.float32)
    offsets_ns = np.zeros(shape, dtype=np.int64)
    for hand, name, ranges in _touch_ranges(reader, t_ns):
        data = reader.read(name)
        for frame, (low, high) in enumerate(ranges.tolist()):
            first = max(low, high - num_samples)
            kpa[frame, : high - first, hand] = data.values[first:high]
            offsets_ns[frame, : high - first, hand] = data.t_ref_ns[first:high] - t_ns[frame]
    counts = touch_counts(reader, t_ns)
    return {SAMPLES: kpa, SAMPLES_DT: offsets_ns, SAMPLES_COUNT: counts}


def value_statistics(values: np.ndarray) -> Statistics:
    """Of finite numbers [frame, ...]: all but the last axis is pooled, as LeRobot does it."""
    rows = np.asarray(values, dtype=np.float64).reshape(-1, values.shape[-1])
    if values.ndim == 1:
        rows = np.asarray(values, dtype=np.float64)[:, None]
    statistics: Statistics = {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(values)], dtype=np.int64),
    }
    levels = np.quantile(rows, list(QUANTILES.values()), axis=0)
    statistics.update(zip(QUANTILES, levels, strict=True))
    return statistics


def image_statistics(images: Iterable[UInt8[np.ndarray, "h w 3"]]) -> Statistics:
    """Of at least one image: levels scaled to 0 … 1, each statistic of shape [3, 1, 1].

    Large images are subsampled. The histogram of each channel over 256 levels gives exact
    statistics of any number of images.
    """
    counts, num_images = np.zeros((3, 256), dtype=np.int64), 0
    for image in images:
        step = max(1, -(-max(image.shape[:2]) // SAMPLED_SIDE_PX))
        for channel, levels in enumerate(np.moveaxis(image[::step, ::step], -1, 0)):
            counts[channel] += np.bincount(levels.ravel(), minlength=256)
        num_images += 1
    level = np.arange(256) / 255
    share = counts / counts.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(share, axis=1)
    mean = share @ level
    present = counts > 0
    numbers = {
        "min": level[present.argmax(axis=1)],
        "max": level[255 - present[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(0.0, share @ level**2 - mean**2)),
    }
    for name, q in QUANTILES.items():
        # The lowest level with at least that share of the pixels at or below it.
        numbers[name] = level[(cumulative < q - 1e-12).sum(axis=1)]
    result: Statistics = {name: value.reshape(3, 1, 1) for name, value in numbers.items()}
    return result | {"count": np.array([num_images], dtype=np.int64)}


def combine(first: Statistics | None, second: Statistics) -> Statistics:
    """Statistics of two sets of frames together.

    All but the quantiles are those of the union; a quantile is the mean of both, weighted by their
    counts, which is what LeRobot keeps.
    """
    if first is None:
        return second
    num_first, num_second = int(first["count"][0]), int(second["count"][0])
    total = num_first + num_second
    weight = num_second / total
    shift = second["mean"] - first["mean"]
    spread = (1 - weight) * first["std"] ** 2 + weight * second["std"] ** 2
    combined: Statistics = {
        "min": np.minimum(first["min"], second["min"]),
        "max": np.maximum(first["max"], second["max"]),
        "mean": first["mean"] + weight * shift,
        "std": np.sqrt(spread + weight * (1 - weight) * shift**2),
        "count": np.array([total], dtype=np.int64),
    }
    for name in QUANTILES:
        combined[name] = first[name] + weight * (second[name] - first[name])
    return combined


def sampled_images(
    reader: EpisodeReader, camera: str, indices: np.ndarray
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Images of a camera, evenly spread over those of the frames, at most SAMPLED_IMAGES.

    Of H.264 the first images of groups, which are decoded alone.
    """
    places = np.linspace(0, len(indices) - 1, min(len(indices), SAMPLED_IMAGES))
    chosen = indices[np.rint(places).astype(np.int64)]
    if reader.streams[camera].unit == H264_UNIT:
        chosen = np.maximum(chosen - chosen % GOP_IMAGES, indices[0])
    return (reader.images_at(camera, index[None])[0] for index in np.unique(chosen))
