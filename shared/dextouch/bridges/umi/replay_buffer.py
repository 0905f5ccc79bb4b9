"""Episodes in one zip file in the layout of UMI's replay buffer: export, and import of exports."""

from collections.abc import Iterable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float64, UInt8
from pydantic import Field, ValidationError

from dextouch.bridges.exports import new_file
from dextouch.bridges.model_grid import (
    BLOCK_IMAGES,
    GridEpisode,
    GridImages,
    GridNumbers,
    store_episode,
    tactile_numbers,
)
from dextouch.bridges.umi.zarr_zip import ZarrZipReader, ZarrZipWriter
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.geometry import pose_from_transform
from dextouch.geometry.rotations import vector_from_rotation
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, poses_from_actions
from dextouch.schemas import EpisodeAttributes, LineageEntry, first_problems, json_ready

MAX_EPISODES: Final = 1_000_000
MAX_STEPS: Final = 100_000
MODEL_CAMERAS: Final = ("camera_wrist_left", "camera_wrist_right", "camera_head")
ENDS: Final = "meta/episode_ends"
COMMANDED: Final = "data/action_commanded"
# Images of a camera by its number, and their times minus those of the steps.
CAMERA_ARRAY: Final = "data/camera{}_rgb"
CAMERA_DT_ARRAY: Final = "data/camera{}_dt_ns"
ATTRIBUTES_KEY: Final = "dextouch"
LAYOUT_VERSION: Final = 1
BLOCK_STEPS = 32
_HAND = {
    "eef_pos": ("<f4", (3,)),
    "eef_rot_axis_angle": ("<f4", (3,)),
    "joint_pos": ("<f4", (20,)),
    "demo_start_pose": ("<f8", (6,)),
    "demo_end_pose": ("<f8", (6,)),
}
# Arrays of numbers: type and shape of a row. robot0 is the left hand, robot1 the right one.
NUMBERS: Final[dict[str, tuple[str, tuple[int, ...]]]] = {
    **{f"data/{robot}_{n}": kind for robot in ("robot0", "robot1") for n, kind in _HAND.items()},
    "data/head_pos": ("<f4", (3,)),
    "data/head_rot_axis_angle": ("<f4", (3,)),
    "data/tactile": ("<f4", (2, 320)),
    "data/tactile_valid": ("|b1", (2,)),
    "data/action": ("<f8", (67,)),
    "data/t_ref_ns": ("<i8", ()),
}


def export_umi(readers: Iterable[EpisodeReader], path: Path, *, overwrite: bool = False) -> int:
    """Write episodes one after another on the model grid.

    Args:
        readers: of episodes with the same cameras and image sizes; each is read once.
        path: of the new zip file.
        overwrite: whether an existing file is replaced.

    Returns:
        Number of steps.

    Raises:
        ConflictError: the file exists.
        InvalidInputError: no episode, or one that is inconsistent with the first.
        StorageError: the write failed.
    """
    first: dict[str, tuple[int, ...]] | None = None
    cameras: tuple[str, ...] = ()
    ends, attributes = [0], []
    with new_file(path, overwrite=overwrite) as file, closing(ZarrZipWriter(file)) as writer:
        for reader in readers:
            shared = _shared(reader)
            if first is None:
                first, cameras = shared, tuple(name for name in MODEL_CAMERAS if name in shared)
            elif shared != first:
                raise InvalidInputError(
                    f"{reader.attributes.episode_id}: got {shared}, expected {first} as in the "
                    "first episode; export episodes of different cameras to different files"
                )
            _append(writer, reader, cameras)
            ends.append(ends[-1] + reader.num_steps)
            known = json_ready(reader.attributes)
            attributes.append({"attributes": known, "content_sha256": reader.content_sha256})
        if first is None:
            raise InvalidInputError("UMI export: got no episode, expected at least one")
        writer.append(ENDS, np.array(ends[1:], dtype="<i8"))
        about = {"layout_version": LAYOUT_VERSION, "cameras": cameras, "episodes": attributes}
        texts: dict[str, dict[str, Any]] = {
            "": {"layout": "UMI replay buffer, two hands, with touch"},
            "meta": {ATTRIBUTES_KEY: about},
        }
        writer.finish(
            texts | {CAMERA_ARRAY.format(i): {"stream": n} for i, n in enumerate(cameras)}
        )
    return ends[-1]


def _shared(reader: EpisodeReader) -> dict[str, tuple[int, ...]]:
    """What all episodes of a file have in common: shapes of images and of commanded actions."""
    if reader.num_steps == 0:
        raise InvalidInputError(
            f"{reader.attributes.episode_id}: has no step of the model grid to export"
        )
    names = (*MODEL_CAMERAS, "action_commanded")
    return {name: reader.streams[name].shape for name in names if name in reader.streams}


def _append(writer: ZarrZipWriter, reader: EpisodeReader, cameras: tuple[str, ...]) -> None:
    for name, rows in _numbers(reader).items():
        writer.append(name, rows.astype(NUMBERS[name][0] if name in NUMBERS else "<f8"))
    for start in range(0, reader.num_steps, BLOCK_STEPS):
        count = min(BLOCK_STEPS, reader.num_steps - start)
        window = reader.window(start, count, cameras=cameras)
        for index, camera in enumerate(cameras):
            writer.append(CAMERA_ARRAY.format(index), window.images[camera], chunk_rows=1)
            writer.append(CAMERA_DT_ARRAY.format(index), window.image_dt_ns[camera])
        writer.append("data/tactile", window.tactile_kpa)
        writer.append("data/tactile_valid", window.tactile_valid)


def _numbers(reader: EpisodeReader) -> dict[str, np.ndarray]:
    """Rows of an episode's arrays, except for those that `EpisodeReader.window` resamples."""
    data = reader.read("action")
    arrays = {"data/t_ref_ns": data.t_ref_ns, "data/action": data.values}
    if "action_commanded" in reader.streams:
        commanded = reader.read("action_commanded")
        if not np.array_equal(commanded.t_ref_ns, data.t_ref_ns):
            raise InvalidInputError(
                f"{reader.attributes.episode_id}: action_commanded is not on the grid of action"
            )
        arrays[COMMANDED] = commanded.values
    poses = poses_from_actions(data.values, reader.attributes.anchor.to_poses())
    for robot, Ts_world_wrist, joints_rad in (
        ("robot0", poses.Ts_world_wrist_left, poses.joints_left_rad),
        ("robot1", poses.Ts_world_wrist_right, poses.joints_right_rad),
    ):
        pose = _pose_6d(Ts_world_wrist)
        arrays |= {
            f"data/{robot}_eef_pos": pose[:, :3],
            f"data/{robot}_eef_rot_axis_angle": pose[:, 3:],
            f"data/{robot}_joint_pos": joints_rad,
            f"data/{robot}_demo_start_pose": np.broadcast_to(pose[0], pose.shape),
            f"data/{robot}_demo_end_pose": np.broadcast_to(pose[-1], pose.shape),
        }
    head = _pose_6d(poses.Ts_world_camera_head)
    return arrays | {"data/head_pos": head[:, :3], "data/head_rot_axis_angle": head[:, 3:]}


def _pose_6d(Ts: np.ndarray) -> Float64[np.ndarray, "n 6"]:
    """Translation in metres and rotation vector in radians."""
    return np.concatenate([Ts[:, :3, 3], vector_from_rotation(Ts[:, :3, :3])], axis=1)


class _Episode(FrozenModel):
    attributes: EpisodeAttributes
    content_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class _Meta(FrozenModel):
    layout_version: int
    cameras: tuple[str, ...]
    episodes: tuple[_Episode, ...] = Field(max_length=MAX_EPISODES)


def import_umi(path: Path, store: EpisodeStore) -> list[str]:
    """Import a zip file written by `export_umi` into a store.

    The episodes are on the model grid: samples between the steps are not in the file.

    Args:
        path: of the file; it may come from anywhere.
        store: where the episodes appear under the ids that they had.

    Returns:
        The ids.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: a replay buffer not written by DexTouch.
        CorruptDataError: truncated or damaged; episodes before the damage may be in the store.
        LimitExceededError: larger than the limits of this reader.
        ConflictError: an id is in the store already.
    """
    with closing(ZarrZipReader(path)) as archive:
        meta = _meta(archive, path)
        ends = _ends(archive, path, meta)
        for episode, start, stop in zip(meta.episodes, [0, *ends], ends, strict=False):
            source = episode.attributes
            entry = LineageEntry(
                kind="episode", id=source.episode_id, sha256=episode.content_sha256
            )
            lineage = (*source.lineage, entry)
            attributes = source.model_copy(update={"streams": (), "lineage": lineage})
            rows = slice(start, stop)
            store_episode(store, attributes, _episode(archive, attributes, meta.cameras, rows))
    return [episode.attributes.episode_id for episode in meta.episodes]


def _meta(archive: ZarrZipReader, path: Path) -> _Meta:
    plain = archive.attributes("meta").get(ATTRIBUTES_KEY)
    if not isinstance(plain, dict):
        raise InvalidInputError(
            f"{path}: has no DexTouch attributes in meta/.zattrs; only files that "
            "`dextouch export --format umi` wrote can be imported (other replay buffers hold no "
            "67-D actions)"
        )
    if plain.get("layout_version") != LAYOUT_VERSION:
        raise StorageError(
            f"{path}: got layout version {plain.get('layout_version')!r}, expected "
            f"{LAYOUT_VERSION}; read it with the release that wrote it"
        )
    try:
        meta = _Meta.model_validate(plain)
    except ValidationError as error:
        raise CorruptDataError(
            f"{path}: attributes in meta/.zattrs are invalid ({first_problems(error)})"
        ) from error
    if not set(meta.cameras) <= set(MODEL_CAMERAS) or len(set(meta.cameras)) != len(meta.cameras):
        raise CorruptDataError(f"{path}: got cameras {meta.cameras}, expected of {MODEL_CAMERAS}")
    return meta


def _ends(archive: ZarrZipReader, path: Path, meta: _Meta) -> list[int]:
    num_episodes = len(meta.episodes)
    shape = archive.metadata(ENDS).shape
    if shape != (num_episodes,):
        raise CorruptDataError(f"{path}: {ENDS} has shape {shape}, expected ({num_episodes},)")
    ends = archive.read(ENDS, 0, num_episodes)
    names = [*NUMBERS, *(CAMERA_ARRAY.format(index) for index in range(len(meta.cameras)))]
    rows = {name: archive.metadata(name).shape[0] for name in names}
    rising = bool((np.diff(ends, prepend=0) > 0).all())
    if ends.dtype != np.int64 or not rising or set(rows.values()) != {int(ends[-1])}:
        raise CorruptDataError(f"{path}: {ENDS} is inconsistent with the arrays of {rows} rows")
    longest = int(np.diff(ends, prepend=0).max())
    if longest > MAX_STEPS:
        raise LimitExceededError(
            f"{path}: an episode has {longest} steps, expected at most {MAX_STEPS}"
        )
    for name, (dtype, row_shape) in NUMBERS.items():
        found = archive.metadata(name)
        if (found.dtype, found.shape[1:]) != (dtype, row_shape):
            raise CorruptDataError(
                f"{path}: {name} holds {found.dtype} {found.shape[1:]}, "
                f"expected {dtype} {row_shape}"
            )
    return [int(end) for end in ends]


def _episode(
    archive: ZarrZipReader, attributes: EpisodeAttributes, cameras: tuple[str, ...], rows: slice
) -> GridEpisode:
    start, stop = rows.start, rows.stop
    t_ref_ns = archive.read("data/t_ref_ns", start, stop)
    actions = archive.read("data/action", start, stop)
    poses = poses_from_actions(actions, attributes.anchor.to_poses())
    numbers = {"action": GridNumbers("robot_state", "action", actions)}
    for name, Ts_world in (
        ("wrist_left", poses.Ts_world_wrist_left),
        ("wrist_right", poses.Ts_world_wrist_right),
        ("head", poses.Ts_world_camera_head),
    ):
        values = pose_from_transform(Ts_world)
        numbers[name] = GridNumbers("pose", "pose_m_wxyz", values, frame="world")
    if COMMANDED in archive:
        commanded = archive.read(COMMANDED, start, stop)
        numbers["action_commanded"] = GridNumbers("robot_state", "action", commanded)
    if attributes.domain == "robot":
        joints = np.concatenate([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1)
        numbers["joints_measured"] = GridNumbers("robot_state", "rad", joints)
    tactile = archive.read("data/tactile", start, stop)
    numbers |= tactile_numbers(tactile, archive.read("data/tactile_valid", start, stop))
    images = {}
    for index, camera in enumerate(cameras):
        name = CAMERA_ARRAY.format(index)
        stamps = t_ref_ns + archive.read(CAMERA_DT_ARRAY.format(index), start, stop)
        shape = archive.metadata(name).shape[1:]
        images[camera] = GridImages(
            shape, stamps, partial(_images, archive, name, rows), frame=camera
        )
    return GridEpisode(t_ref_ns, numbers, images)


def _images(archive: ZarrZipReader, name: str, rows: slice) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    for first in range(rows.start, rows.stop, BLOCK_IMAGES):
        yield from archive.read(name, first, min(first + BLOCK_IMAGES, rows.stop))
