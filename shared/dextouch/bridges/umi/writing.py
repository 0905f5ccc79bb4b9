"""Export of episodes to one zip file in the layout of UMI's replay buffer."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from dextouch.bridges.new_file import new_file
from dextouch.bridges.umi.layout import (
    ATTRIBUTES_KEY,
    CHUNK_ROWS,
    COMMANDED,
    ENDS,
    LAYOUT_VERSION,
    MODEL_CAMERAS,
    NUMBERS,
    ROBOTS,
    camera_array,
    camera_dt_array,
)
from dextouch.bridges.umi.zarr_zip import ZarrZipWriter
from dextouch.episodes import EpisodeReader
from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import vector_from_rotation
from dextouch.hands.actions import poses_from_actions
from dextouch.schemas import json_ready

BLOCK_STEPS = 32


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
    with new_file(path, overwrite=overwrite) as partial:
        writer = ZarrZipWriter(partial)
        try:
            export = _Export(writer)
            for reader in readers:
                export.add(reader)
            return export.finish()
        finally:
            writer.close()


def _signature(reader: EpisodeReader) -> dict[str, tuple[int, ...]]:
    """Properties that all episodes of a file share: image shapes by camera, commanded actions."""
    cameras: dict[str, tuple[int, ...]] = {
        c: reader.streams[c].shape for c in MODEL_CAMERAS if c in reader.streams
    }
    commanded: dict[str, tuple[int, ...]] = (
        {"action_commanded": (67,)} if "action_commanded" in reader.streams else {}
    )
    return {**cameras, **commanded}


class _Export:
    """One file that is being written."""

    def __init__(self, writer: ZarrZipWriter) -> None:
        self._writer = writer
        self._signature: dict[str, tuple[int, ...]] | None = None
        self._cameras: tuple[str, ...] = ()
        self._attributes: list[dict[str, Any]] = []
        self._ends: list[int] = []

    def add(self, reader: EpisodeReader) -> None:
        """Append one episode."""
        episode_id, signature = reader.attributes.episode_id, _signature(reader)
        if reader.num_steps == 0:
            raise InvalidInputError(f"{episode_id}: has no step of the model grid to export")
        if self._signature is None:
            self._start(signature)
        elif signature != self._signature:
            raise InvalidInputError(
                f"{episode_id}: got {signature}, expected {self._signature} as in the first "
                "episode; export episodes of different cameras to different files"
            )
        for name, rows in _numbers(reader).items():
            self._writer.append(name, rows)
        for start in range(0, reader.num_steps, BLOCK_STEPS):
            self._add_windows(reader, start, min(BLOCK_STEPS, reader.num_steps - start))
        self._ends.append((self._ends[-1] if self._ends else 0) + reader.num_steps)
        self._attributes.append(
            {"attributes": json_ready(reader.attributes), "content_sha256": reader.content_sha256}
        )

    def _start(self, signature: dict[str, tuple[int, ...]]) -> None:
        self._signature = signature
        self._cameras = tuple(name for name in MODEL_CAMERAS if name in signature)
        for index, camera in enumerate(self._cameras):
            self._writer.add_array(
                camera_array(index),
                dtype="uint8",
                row_shape=signature[camera],
                chunk_rows=1,
                attributes={"stream": camera},
            )
            self._add_numbers(camera_dt_array(index), "<i8", ())
        for name, (dtype, shape) in NUMBERS.items():
            self._add_numbers(name, dtype, shape)
        if "action_commanded" in signature:
            self._add_numbers(COMMANDED, "<f8", (67,))
        self._add_numbers(ENDS, "<i8", ())

    def _add_numbers(self, name: str, dtype: str, shape: tuple[int, ...]) -> None:
        self._writer.add_array(name, dtype=dtype, row_shape=shape, chunk_rows=CHUNK_ROWS)

    def _add_windows(self, reader: EpisodeReader, start: int, num_steps: int) -> None:
        window = reader.window(start, num_steps, cameras=self._cameras)
        for index, camera in enumerate(self._cameras):
            self._writer.append(camera_array(index), window.images[camera])
            self._writer.append(camera_dt_array(index), window.image_dt_ns[camera])
        self._writer.append("data/tactile", window.tactile_kpa)
        self._writer.append("data/tactile_valid", window.tactile_valid)

    def finish(self) -> int:
        """Complete the file and return the number of steps."""
        if not self._ends:
            raise InvalidInputError("UMI export: got no episode, expected at least one")
        self._writer.append(ENDS, np.array(self._ends, dtype=np.int64))
        self._writer.finish(
            {
                "": {"layout": "UMI replay buffer, two hands, with touch"},
                "meta": {
                    ATTRIBUTES_KEY: {
                        "layout_version": LAYOUT_VERSION,
                        "cameras": list(self._cameras),
                        "episodes": self._attributes,
                    }
                },
            }
        )
        return self._ends[-1]


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
    hands = {
        "left": (poses.Ts_world_wrist_left, poses.joints_left_rad),
        "right": (poses.Ts_world_wrist_right, poses.joints_right_rad),
    }
    for robot, side in ROBOTS.items():
        Ts_world_wrist, joints_rad = hands[side]
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
