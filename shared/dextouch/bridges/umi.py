"""Export of episodes as one zip file in the layout of UMI's replay buffer (Zarr v2)."""

import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
import zarr
from jaxtyping import Float64
from zarr.core.common import JSON

from dextouch.bridges.export_files import BLOCK_IMAGES, new_file
from dextouch.episodes import EpisodeReader, disk_errors
from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import vector_from_rotation
from dextouch.hands.actions import poses_from_actions
from dextouch.schemas import json_ready
from dextouch.tactile.layout import TactileLayout, common_layout

MODEL_CAMERAS: Final = ("camera_wrist_left", "camera_wrist_right", "camera_head")
# Images of a camera by its number, and their times minus those of the steps.
CAMERA_ARRAY: Final = "data/camera{}_rgb"
CAMERA_DT_ARRAY: Final = "data/camera{}_dt_ns"
LAYOUT_VERSION: Final = 1
# Rows of a storage chunk of numbers; images have one chunk each.
CHUNK_ROWS: Final = 256
# The earliest date that a zip can name: equal episodes give equal bytes.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
_HAND = {
    "eef_pos": "<f4",
    "eef_rot_axis_angle": "<f4",
    "joint_pos": "<f4",
    "demo_start_pose": "<f8",
    "demo_end_pose": "<f8",
}
# Types of the numbers that `EpisodeReader.window` does not resample. robot0 is the left hand,
# robot1 the right one.
NUMBERS: Final[dict[str, str]] = {
    **{f"data/{robot}_{n}": dtype for robot in ("robot0", "robot1") for n, dtype in _HAND.items()},
    "data/head_pos": "<f4",
    "data/head_rot_axis_angle": "<f4",
    "data/action": "<f8",
    "data/action_commanded": "<f8",
    "data/t_ref_ns": "<i8",
}


def export_umi(readers: Iterable[EpisodeReader], path: Path, *, overwrite: bool = False) -> int:
    """Write episodes one after another on the model grid to a zip, and return the number of steps.

    Raises:
        ConflictError: the file exists, and is not to be overwritten.
        InvalidInputError: no episode, or one whose cameras, images, rate or taxels are not the
            first one's.
        StorageError: the write failed.
    """
    with (
        new_file(path, overwrite=overwrite) as file,
        tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder,
        disk_errors(str(path)),
    ):
        num_steps = _write_group(zarr.open_group(folder, mode="w", zarr_format=2), readers)
        # Its files are compressed already.
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for entry in sorted(path for path in Path(folder).rglob("*") if path.is_file()):
                about = zipfile.ZipInfo(entry.relative_to(folder).as_posix(), _ZIP_DATE)
                archive.writestr(about, entry.read_bytes())
    return num_steps


def _write_group(group: zarr.Group, readers: Iterable[EpisodeReader]) -> int:
    first: dict[str, tuple[object, ...]] | None = None
    cameras: tuple[str, ...] = ()
    layouts: list[TactileLayout] = []
    ends = [0]
    episodes: list[JSON] = []
    for reader in readers:
        shared = _shared(reader)
        if first is None:
            first, cameras = shared, tuple(name for name in MODEL_CAMERAS if name in shared)
        elif shared != first:
            raise InvalidInputError(
                f"{reader.attributes.episode_id}: got {shared}, expected {first} as in the "
                "first episode; export episodes that differ in these to different files"
            )
        layouts = [common_layout([*layouts, reader.tactile_layout], what="UMI export")]
        _append_episode(group, reader, cameras)
        ends.append(ends[-1] + reader.num_steps)
        episodes.append(
            {"attributes": json_ready(reader.attributes), "content_sha256": reader.content_sha256}
        )
    if first is None:
        raise InvalidInputError("UMI export: got no episode, expected at least one")
    _append(group, "meta/episode_ends", np.array(ends[1:], dtype="<i8"))
    group.attrs["layout"] = "UMI replay buffer, two hands, with touch"
    group.require_group("meta").attrs["dextouch"] = {
        "layout_version": LAYOUT_VERSION,
        "cameras": cameras,
        "episodes": episodes,
    }
    return ends[-1]


def _append(
    group: zarr.Group,
    name: str,
    rows: np.ndarray,
    chunk_rows: int = CHUNK_ROWS,
    attributes: Mapping[str, JSON] | None = None,
) -> None:
    """Append rows to an array, which is created with its attributes by the first ones."""
    array = group.get(name)
    if isinstance(array, zarr.Array):
        array.append(rows)
        return
    group.create_array(
        name,
        data=np.ascontiguousarray(rows),
        chunks=(chunk_rows, *rows.shape[1:]),
        attributes=dict(attributes or {}),
    )


def _shared(reader: EpisodeReader) -> dict[str, tuple[object, ...]]:
    """What all episodes of a file have in common: rate, form of images and commanded actions."""
    if reader.num_steps == 0:
        raise InvalidInputError(
            f"{reader.attributes.episode_id}: has no step of the model grid to export"
        )
    names = (*MODEL_CAMERAS, "action_commanded")
    streams = [reader.streams[name] for name in names if name in reader.streams]
    forms = {one.name: (one.dtype, *one.shape) for one in streams}
    return {"model_rate_hz": (reader.attributes.model_rate_hz,), **forms}


def _append_episode(group: zarr.Group, reader: EpisodeReader, cameras: tuple[str, ...]) -> None:
    for name, rows in _numbers(reader).items():
        _append(group, name, rows.astype(NUMBERS[name]))
    for start in range(0, reader.num_steps, BLOCK_IMAGES):
        count = min(BLOCK_IMAGES, reader.num_steps - start)
        window = reader.window(start, count, cameras=cameras)
        for index, camera in enumerate(cameras):
            name, about = CAMERA_ARRAY.format(index), {"stream": camera}
            _append(group, name, window.images[camera], chunk_rows=1, attributes=about)
            _append(group, CAMERA_DT_ARRAY.format(index), window.image_dt_ns[camera])
        _append(group, "data/tactile", window.tactile_kpa)
        _append(group, "data/tactile_valid", window.tactile_valid)


def _numbers(reader: EpisodeReader) -> dict[str, np.ndarray]:
    data = reader.read("action")
    arrays = {"data/t_ref_ns": data.t_ref_ns, "data/action": data.values}
    if "action_commanded" in reader.streams:
        commanded = reader.read("action_commanded")
        if not np.array_equal(commanded.t_ref_ns, data.t_ref_ns):
            raise InvalidInputError(
                f"{reader.attributes.episode_id}: action_commanded is not on the grid of action"
            )
        arrays["data/action_commanded"] = commanded.values
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
