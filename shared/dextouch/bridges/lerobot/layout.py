"""Feature names, shapes, paths and constants of the LeRobotDataset v3.0 layout."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Field

from dextouch.errors import CorruptDataError, InvalidInputError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.robot_hand import RobotHand
from dextouch.schemas import ActionKind, EpisodeAttributes
from dextouch.tactile.layout import NUM_TAXELS, SIDES

CODEBASE_VERSION: Final = "v3.0"
INFO_FILE: Final = "meta/info.json"
STATS_FILE: Final = "meta/stats.json"
TASKS_FILE: Final = "meta/tasks.parquet"
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

Feature = dict[str, Any]
Features = dict[str, Feature]
Grid = Literal["model", "camera", "uniform"]

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


def action_names() -> list[str]:
    """Names of the 67 components of an action or a state, in order.

    A pose is a translation in metres and two columns of the rotation matrix.
    """
    rotation = [f"r{row}{column}" for column in (0, 1) for row in range(3)]
    left, right, head = (
        [f"{name}.{part}" for part in ("x_m", "y_m", "z_m", *rotation)]
        for name in ("wrist_left", "wrist_right", "camera_head")
    )
    joints = [f"{name}_rad" for side in SIDES for name in RobotHand(side).joint_names]
    return [*left, *right, *joints, *head]


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
    cameras: Mapping[str, Sequence[int]], fps: int, *, has_measured: bool
) -> Features:
    """Every feature of an export, by name.

    `cameras` holds the shape [height, width, 3] of each camera's images; with `has_measured`
    actions are commanded ones, and measured ones are stored beside them.
    """
    names = action_names()
    pose, number = _feature("float32", [len(names)], names), _feature("int64", [1])
    features = {IMAGES + name: _video_feature(shape, fps) for name, shape in cameras.items()}
    features[STATE] = pose
    features[TACTILE] = _feature("float32", [2, NUM_TAXELS], ["hand", "taxel_kpa"])
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
    """Substitute the fields of a path template; only plain fields are supported.

    Raises:
        InvalidInputError: a field that is not among `values`, or any other brace.
    """
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
    """Resolve a path below `folder`, following links.

    Raises:
        CorruptDataError: it leads out of the folder.
    """
    root = folder.resolve()
    if "\0" in relative:
        raise CorruptDataError(f"{folder}: got a path with a zero byte")
    path = (root / relative).resolve()
    if not path.is_relative_to(root):
        raise CorruptDataError(f"{folder}: path {relative!r} leads out of the dataset; refused")
    return path
