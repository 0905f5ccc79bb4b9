"""Writer of a LeRobotDataset v3.0: data and video files, episode table, metadata and card."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.rows import EpisodeFrames
from dextouch.bridges.lerobot.statistics import Statistics, combine, value_statistics
from dextouch.bridges.lerobot.video import CameraVideo
from dextouch.episodes import disk_errors
from dextouch.errors import InvalidInputError

# Rows of the table of episodes that are written together.
ROWS_AT_ONCE: Final = 100


def _data_table(features: layout.Features, columns: Mapping[str, np.ndarray]) -> pa.Table:
    """Rows of the data files from columns [n, *shape].

    A feature of shape [1] is a plain value, one of another axis a fixed list, one of several axes
    lists of lists.
    """
    table = {}
    for name, values in columns.items():
        shape = [] if features[name]["shape"] == [1] else features[name]["shape"]
        column = pa.array(np.asarray(values, dtype=features[name]["dtype"]).reshape(-1))
        kind = column.type
        for size in reversed(shape):
            column = pa.FixedSizeListArray.from_arrays(column, size)
            kind = pa.list_(kind, size if len(shape) == 1 else -1)
        table[name] = column.cast(kind)
    return pa.Table.from_pydict(table)


class _ParquetFiles:
    """Numbered parquet files of one kind; each table becomes a row group."""

    def __init__(self, folder: Path, template: str, *, file_bytes: int = sys.maxsize) -> None:
        self._folder, self._template, self._file_bytes = folder, template, file_bytes
        self._path, self._number = folder, -1
        self._writer: pq.ParquetWriter | None = None

    def append(self, table: pa.Table) -> int:
        """Write a table and return the number of its file."""
        with disk_errors(f"write a table of {self._folder}"):
            if self._writer is None or self._path.stat().st_size >= self._file_bytes:
                self.close()
                self._number += 1
                self._path = layout.numbered_path(self._folder, self._template, self._number)
                self._writer = pq.ParquetWriter(self._path, table.schema, compression="snappy")
            self._writer.write_table(table)
        return self._number

    def close(self) -> None:
        """Complete the file that is open."""
        if self._writer is not None:
            with disk_errors(f"complete {self._path}"):
                self._writer.close()
            self._writer = None


class DatasetWriter:
    """Writes a new dataset episode by episode; `finish` writes the metadata.

    `cameras` holds the shape [height, width, 3] of each camera's images; with `has_measured`
    actions are commanded ones, and measured ones are stored beside them.

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
        self._data = _ParquetFiles(folder, layout.DATA_PATH, file_bytes=layout.DATA_FILE_MB << 20)
        self._episodes = _ParquetFiles(folder, layout.EPISODES_PATH)
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
        sidecar: layout.Sidecar,
    ) -> None:
        """Write one episode, with an access unit of each camera a frame.

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
        file_number = self._data.append(_data_table(self._features, columns))
        row["data/chunk_index"], row["data/file_index"] = layout.file_place(file_number)
        row["dataset_from_index"] = self.num_frames
        row["dataset_to_index"] = self.num_frames + len(frames)
        statistics = {name: value_statistics(column) for name, column in columns.items()}
        statistics.update(image_statistics)
        for name, values in statistics.items():
            self._total[name] = combine(self._total.get(name), values)
            row.update({f"stats/{name}/{kind}": value.tolist() for kind, value in values.items()})
        name = layout.SIDECAR_PATH.format(episode_index=sidecar.episode_index)
        self._write(name, json.dumps(sidecar.model_dump(mode="json"), indent=2) + "\n")
        row["meta/episodes/chunk_index"] = row["meta/episodes/file_index"] = 0
        self._rows.append(row)
        if len(self._rows) == ROWS_AT_ONCE:
            self._write_rows()
        self.num_frames += len(frames)
        self.num_episodes += 1

    def _columns(self, frames: EpisodeFrames, task_index: int) -> dict[str, np.ndarray]:
        frame_index = np.arange(len(frames), dtype=np.int64)
        columns = frames.columns | {
            "timestamp": (frame_index / self.fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full_like(frame_index, self.num_episodes),
            "index": self.num_frames + frame_index,
            "task_index": np.full_like(frame_index, task_index),
        }
        return {name: columns[name] for name in self._features if name in columns}

    def close(self) -> None:
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
        """Complete the files and write the metadata; `repo_id` is the dataset's name.

        Raises:
            StorageError: the write failed.
        """
        self.close()
        self._write_tasks()
        statistics = {
            name: {kind: value.tolist() for kind, value in values.items()}
            for name, values in self._total.items()
        }
        for name, content in ((layout.STATS_FILE, statistics), (layout.INFO_FILE, self._info())):
            self._write(name, json.dumps(content, indent=4, allow_nan=False) + "\n")
        self._write(layout.CARD_FILE, _card(repo_id))

    def _write_tasks(self) -> None:
        """A table whose pandas index is the task's text."""
        kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "str")}
        described = [
            {"name": n, "field_name": n, "pandas_type": p, "numpy_type": d, "metadata": None}
            for n, (p, d) in kinds.items()
        ]
        header = {"index_columns": ["task"], "column_indexes": [], "columns": described}
        numbers = pa.array(np.arange(len(self._tasks), dtype=np.int64))
        texts = pa.array(list(self._tasks), pa.string())
        table = pa.Table.from_pydict({"task_index": numbers, "task": texts})
        path = self._folder / layout.TASKS_FILE
        with disk_errors(f"write {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(header)}), path)

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

    def _write(self, name: str, text: str) -> None:
        path = self._folder / name
        with disk_errors(f"write {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)


def _card(repo_id: str) -> str:
    front = (
        "---\ntags:\n- LeRobot\nconfigs:\n- config_name: default\n"
        "  data_files: data/*/*.parquet\n---\n"
    )
    return (
        f"{front}\n# {repo_id}\n\nA LeRobotDataset {layout.CODEBASE_VERSION} exported from "
        "DexTouch episodes. What LeRobot has no field for is in `meta/dextouch`.\n"
    )
