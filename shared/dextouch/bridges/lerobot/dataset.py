"""Writer of a LeRobotDataset v3.0: data and video files, episode table, metadata and card."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.rows import EpisodeFrames
from dextouch.bridges.lerobot.sidecar import Sidecar, write_sidecar
from dextouch.bridges.lerobot.statistics import Statistics, combine, value_statistics
from dextouch.bridges.lerobot.tables import ParquetFiles, data_table, write_tasks
from dextouch.bridges.lerobot.video import CameraVideo
from dextouch.episodes import disk_errors
from dextouch.errors import InvalidInputError

# Rows of the table of episodes that are written together.
ROWS_AT_ONCE: Final = 100


class DatasetWriter:
    """Writes one dataset episode by episode; `finish` writes the metadata.

    Args:
        folder: of the dataset, new.
        cameras: shape [height, width, 3] of each camera's images.
        fps: frames a second.
        has_measured: actions are commanded ones, and measured ones are stored beside them.
        robot_type: as the dataset names it.

    Raises:
        InvalidInputError: a rate outside 1 … 1000.
    """

    def __init__(
        self,
        folder: Path,
        *,
        cameras: Mapping[str, Sequence[int]],
        fps: int,
        has_measured: bool,
        robot_type: str,
    ) -> None:
        if not 1 <= fps <= 1000:
            raise InvalidInputError(f"fps: got {fps}, expected 1 … 1000")
        self.fps, self.num_frames, self.num_episodes = fps, 0, 0
        self._folder, self._robot_type, self._has_measured = folder, robot_type, has_measured
        self._features = layout.dataset_features(cameras, fps, has_measured=has_measured)
        self._tasks: dict[str, int] = {}
        self._total: dict[str, Statistics] = {}
        with disk_errors(f"create {folder}"):
            folder.mkdir(parents=True)
        self._data = ParquetFiles(folder, layout.DATA_PATH, file_bytes=layout.DATA_FILE_MB << 20)
        self._episodes = ParquetFiles(folder, layout.EPISODES_PATH)
        self._rows: list[dict[str, Any]] = []
        self._videos = {
            camera: CameraVideo(folder, layout.IMAGES + camera, fps=fps, shape=shape)
            for camera, shape in cameras.items()
        }

    def append(
        self,
        frames: EpisodeFrames,
        videos: Mapping[str, Sequence[bytes]],
        image_statistics: Mapping[str, Statistics],
        sidecar: Sidecar,
    ) -> None:
        """Write one episode.

        Args:
            frames: of the episode.
            videos: access units of each camera, one a frame.
            image_statistics: of each camera's feature.
            sidecar: DexTouch attributes that LeRobot has no field for.

        Raises:
            InvalidInputError: an episode that is inconsistent with those before it.
            CorruptDataError: invalid video data.
            StorageError: the write failed.
        """
        attributes = sidecar.attributes
        where = f"episode {attributes.episode_id!r}"
        if (sidecar.action_kind == "commanded") != self._has_measured:
            raise InvalidInputError(
                f"{where}: got {sidecar.action_kind} actions; export episodes with commanded "
                "actions and those without into different datasets"
            )
        row: dict[str, Any] = {"episode_index": self.num_episodes, "length": len(frames)}
        row["tasks"] = [attributes.instruction or attributes.task]
        task_index = self._tasks.setdefault(row["tasks"][0], len(self._tasks))
        for camera, units in videos.items():
            if len(units) != len(frames):
                raise InvalidInputError(
                    f"{where}: {camera!r} gives {len(units)} images for {len(frames)} frames"
                )
            place = self._videos[camera].append(units, where=f"{where}: {camera!r}")
            key = f"videos/{layout.IMAGES}{camera}"
            chunk_file = layout.file_place(place.file_number)
            row[f"{key}/chunk_index"], row[f"{key}/file_index"] = chunk_file
            row[f"{key}/from_timestamp"] = place.from_timestamp_s
            row[f"{key}/to_timestamp"] = place.to_timestamp_s
        columns = self._columns(frames, task_index)
        file_number = self._data.append(data_table(self._features, columns))
        row["data/chunk_index"], row["data/file_index"] = layout.file_place(file_number)
        row["dataset_from_index"] = self.num_frames
        row["dataset_to_index"] = self.num_frames + len(frames)
        statistics = {name: value_statistics(column) for name, column in columns.items()}
        statistics.update(image_statistics)
        for name, values in statistics.items():
            self._total[name] = combine(self._total.get(name), values)
            row.update({f"stats/{name}/{kind}": value.tolist() for kind, value in values.items()})
        write_sidecar(self._folder, sidecar)
        row["meta/episodes/chunk_index"] = row["meta/episodes/file_index"] = 0
        self._rows.append(row)
        if len(self._rows) == ROWS_AT_ONCE:
            self._write_rows()
        self.num_frames += len(frames)
        self.num_episodes += 1

    def _columns(self, frames: EpisodeFrames, task_index: int) -> dict[str, np.ndarray]:
        count = len(frames)
        frame_index = np.arange(count, dtype=np.int64)
        columns = {
            layout.STATE: frames.state,
            layout.TACTILE: frames.tactile_kpa,
            layout.ACTION: frames.action,
            layout.MEASURED: frames.measured,
            layout.VALID: frames.tactile_valid,
            layout.STAMP: frames.t_ref_ns,
            layout.IMAGE_DT: frames.image_dt_ns,
            "timestamp": (frame_index / self.fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full(count, self.num_episodes, dtype=np.int64),
            "index": self.num_frames + frame_index,
            "task_index": np.full(count, task_index, dtype=np.int64),
        }
        return {name: column for name, column in columns.items() if name in self._features}

    def close_files(self) -> None:
        """Complete the data, video and episode files."""
        for video in self._videos.values():
            video.close()
        self._write_rows()
        self._data.close()
        self._episodes.close()

    def _write_rows(self) -> None:
        if self._rows:
            self._episodes.append(pa.Table.from_pylist(self._rows))
            self._rows = []

    def finish(self, repo_id: str) -> None:
        """Write the metadata, when the files are closed.

        Args:
            repo_id: name of the dataset, for its card.

        Raises:
            StorageError: the write failed.
        """
        write_tasks(self._folder / layout.TASKS_FILE, list(self._tasks))
        statistics = {
            name: {kind: value.tolist() for kind, value in values.items()}
            for name, values in self._total.items()
        }
        self._write_json(layout.STATS_FILE, statistics)
        self._write_json(layout.INFO_FILE, self._info())
        with disk_errors(f"write {layout.CARD_FILE}"):
            (self._folder / layout.CARD_FILE).write_text(_card(repo_id))

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": layout.CODEBASE_VERSION,
            "fps": self.fps,
            "features": self._features,
            "total_episodes": self.num_episodes,
            "total_frames": self.num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": layout.CHUNK_FILES,
            "data_files_size_in_mb": layout.DATA_FILE_MB,
            "video_files_size_in_mb": layout.VIDEO_FILE_MB,
            "data_path": layout.DATA_PATH,
            "video_path": layout.VIDEO_PATH if self._videos else None,
            "robot_type": self._robot_type,
            "splits": {"train": f"0:{self.num_episodes}"},
        }

    def _write_json(self, name: str, content: object) -> None:
        path = self._folder / name
        with disk_errors(f"write {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(content, indent=4, allow_nan=False) + "\n")


def _card(repo_id: str) -> str:
    front = (
        "---\ntags:\n- LeRobot\nconfigs:\n- config_name: default\n"
        "  data_files: data/*/*.parquet\n---\n"
    )
    return (
        f"{front}\n# {repo_id}\n\nA LeRobotDataset {layout.CODEBASE_VERSION} exported from "
        "DexTouch episodes. What LeRobot has no field for is in `meta/dextouch`.\n"
    )
