"""Export of episodes to one zip file in the layout of UMI's replay buffer."""

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from dextouch.bridges.exports import new_file
from dextouch.bridges.umi.zarr_zip import ZarrZipWriter
from dextouch.episodes import EpisodeReader
from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import vector_from_rotation
from dextouch.hands.actions import poses_from_actions
from dextouch.schemas import json_ready

MODEL_CAMERAS: Final = ("camera_wrist_left", "camera_wrist_right", "camera_head")
ENDS: Final = "meta/episode_ends"
COMMANDED: Final = "data/action_commanded"
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


def camera_array(index: int) -> str:
    """Name of the image array of a camera."""
    return f"data/camera{index}_rgb"


def camera_dt_array(index: int) -> str:
    """Name of the array of image time minus step time, for a camera."""
    return f"data/camera{index}_dt_ns"


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
    with new_file(path, overwrite=overwrite) as partial, closing(ZarrZipWriter(partial)) as writer:
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
        writer.finish(texts | {camera_array(i): {"stream": n} for i, n in enumerate(cameras)})
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
            writer.append(camera_array(index), window.images[camera], chunk_rows=1)
            writer.append(camera_dt_array(index), window.image_dt_ns[camera])
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
