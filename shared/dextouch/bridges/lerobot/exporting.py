"""Export of episodes to a LeRobotDataset v3.0 folder, which appears complete or not at all."""

import json
import math
import re
import shutil
import sys
import uuid
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dextouch.bridges.export_files import BLOCK_IMAGES, replace_folder
from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.appending import ExistingDataset
from dextouch.bridges.lerobot.card import check_license, write_card
from dextouch.bridges.lerobot.layout import (
    EpisodeFrames,
    Statistics,
    combine,
    frames_of,
    image_statistics,
    sampled_images,
    value_statistics,
)
from dextouch.bridges.lerobot.video import CameraVideo, encode_images, stored_units
from dextouch.episodes import EpisodeReader, VideoSettings, disk_errors
from dextouch.errors import ConflictError, InvalidInputError, ShapeError
from dextouch.streams import StreamDescriptor
from dextouch.tactile.layout import common_layout

# Rows of the table of episodes that are written together.
ROWS_AT_ONCE: Final = 100
REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]{0,95}(/[A-Za-z0-9][\w.-]{0,95})?")

# Of video that has to be encoded.
VIDEO = VideoSettings(crf=23, preset="veryfast")
GROUP_IMAGES: Final = 2


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export.

    `fps`: frames a second, a whole number; without it the model rate of the first episode.
    `cameras`: whose images go along, the first of them setting the frames' times when `fps` is its
    own rate; without it all of the first episode that have colours, the head's first.
    `touch_samples`: also every touch sample since the frame before. `license_name`: identifier of
    the Hub for the dataset's card. `existing`: what to do where the folder is a dataset already:
    refuse, replace it, or append the episodes to it.
    """

    fps: int | None = None
    cameras: tuple[str, ...] | None = None
    touch_samples: bool = False
    license_name: str | None = None
    existing: Literal["refuse", "replace", "append"] = "refuse"


DEFAULTS = ExportOptions()


@dataclass(frozen=True)
class DatasetExport:
    """Result of an export; of an appended one the counts are those of the new episodes.

    `present` are episodes that the dataset had already, `num_touch_left_out` touch samples that did
    not fit into their frame (`ExportOptions.touch_samples`), `cameras_left_out` those without
    colours.
    """

    num_episodes: int
    num_frames: int
    present: tuple[str, ...] = ()
    num_touch_left_out: int = 0
    cameras_left_out: tuple[str, ...] = ()


def export_dataset(
    readers: Iterable[EpisodeReader],
    folder: Path,
    *,
    repo_id: str,
    options: ExportOptions = DEFAULTS,
) -> DatasetExport:
    """Write episodes as one LeRobotDataset v3.0, which appears complete or not at all.

    Readers are opened one at a time, in the order of the dataset. `repo_id` is its name,
    `user/name`. A dataset that is replaced or appended to stays as it was until the new one is
    complete; files that an appended one keeps are not copied.

    Raises:
        ConflictError: the folder exists, is no dataset, or was changed meanwhile.
        InvalidInputError: no episodes, a rate that is not an integer, or episodes that cannot share
            one dataset, such as with a camera that one of them lacks.
        ShapeError: images with an odd side, or of a chosen camera without colours.
        CorruptDataError, StorageError: a damaged episode or dataset; the write failed.
    """
    if not REPO_ID.fullmatch(repo_id):
        raise InvalidInputError(f"repo_id: got {repo_id!r}, expected a name like 'user/name'")
    check_license(options.license_name)
    # A link stays one, and what it names is exchanged where it lies.
    folder = folder.resolve()
    before = _existing(folder, options)
    partial = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
    dataset: _Dataset | None = None
    present: list[str] = []
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, partial, ignore_errors=True)
        for reader in readers:
            if before is not None and reader.content_sha256 in before.content_sha256:
                present.append(reader.item_id)
                continue
            if dataset is None:
                dataset = _Dataset(partial, reader, options, before)
                stack.callback(dataset.close)
            dataset.add(reader)
        if dataset is None:
            if present:
                return DatasetExport(0, 0, tuple(present))
            raise InvalidInputError("export to LeRobot: got no episode, expected at least one")
        dataset.finish(repo_id, options.license_name)
        if before is not None:
            before.check_unchanged()
        if folder.exists():
            replace_folder(partial, folder)
        else:
            with disk_errors(f"complete {folder}"):
                partial.rename(folder)
    return dataset.result(tuple(present))


def _existing(folder: Path, options: ExportOptions) -> ExistingDataset | None:
    """The dataset to append to; raises ConflictError where the folder must not be changed."""
    if not folder.exists():
        return None
    if not (folder / layout.INFO_FILE).is_file():
        raise ConflictError(
            f"{folder}: exists and is not a LeRobot data set; choose another folder (--force and "
            "--append leave it as it is)"
        )
    if options.existing == "refuse":
        raise ConflictError(
            f"{folder}: exists already; choose another folder, or add --append or --force"
        )
    return ExistingDataset.read(folder) if options.existing == "append" else None


def _data_table(features: layout.Features, columns: Mapping[str, np.ndarray]) -> pa.Table:
    """Rows of the data files from columns [n, *shape]; a feature of shape [1] is a plain value."""
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

    def __init__(
        self, folder: Path, template: str, *, file_bytes: int = sys.maxsize, first_file: int = 0
    ) -> None:
        self._folder, self._template, self._file_bytes = folder, template, file_bytes
        self._path, self._number = folder, first_file - 1
        self._writer: pq.ParquetWriter | None = None

    def append(self, table: pa.Table) -> int:
        with disk_errors(f"write a table of {self._folder}"):
            if self._writer is None or self._path.stat().st_size >= self._file_bytes:
                self.close()
                self._number += 1
                self._path = layout.numbered_path(self._folder, self._template, self._number)
                self._writer = pq.ParquetWriter(self._path, table.schema, compression="snappy")
            self._writer.write_table(table)
        return self._number

    def close(self) -> None:
        if self._writer is not None:
            with disk_errors(f"complete {self._path}"):
                self._writer.close()
            self._writer = None


class _Dataset:
    """Writes a new dataset episode by episode; `finish` writes the metadata.

    The first episode decides about cameras, and whether actions are commanded ones. With `before`
    the episodes follow those of that dataset, whose files it takes over.
    """

    def __init__(
        self,
        folder: Path,
        first: EpisodeReader,
        options: ExportOptions,
        before: ExistingDataset | None,
    ) -> None:
        rate_hz, streams = first.attributes.model_rate_hz, first.streams
        if options.fps is None and rate_hz != round(rate_hz):
            raise InvalidInputError(
                f"episode {first.attributes.episode_id!r}: got a model rate of {rate_hz} Hz, "
                "LeRobot counts whole frames a second; give one (`dextouch export --fps`)"
            )
        self.fps = round(rate_hz) if options.fps is None else options.fps
        if not 1 <= self.fps <= 1000:
            raise InvalidInputError(f"fps: got {self.fps}, expected 1 … 1000")
        self._folder = folder
        self._cameras, self._cameras_left_out = _chosen_cameras(first, options)
        _check_cameras(first, self._cameras)
        self._has_measured = "action_commanded" in streams
        shapes = {name: streams[name].shape for name in self._cameras}
        self._tactile_layout = first.tactile_layout
        self._num_samples = _num_samples(first, self._cameras, self.fps, options, before)
        self._features = layout.dataset_features(
            shapes,
            self.fps,
            has_measured=self._has_measured,
            num_taxels=self._tactile_layout.num_taxels,
            num_samples=self._num_samples,
        )
        self.num_frames = self._num_episodes = self._num_left_out = 0
        self._tasks: dict[str, int] = {}
        self._total: dict[str, Statistics] = {}
        self._before = before
        with disk_errors(f"create {folder}"):
            folder.mkdir(parents=True)
        if before is not None:
            before.check_fits(self._features, self.fps)
            before.link_into(folder)
            self.num_frames, self._num_episodes = before.num_frames, len(before.source.episodes)
            self._tasks = {text: number for number, text in before.source.tasks.items()}
            self._total = dict(before.statistics)
        size = layout.DATA_FILE_MB << 20
        data, rows = (self._next_file(one) for one in (layout.DATA_PATH, layout.EPISODES_PATH))
        self._data = _ParquetFiles(folder, layout.DATA_PATH, file_bytes=size, first_file=data)
        self._episodes = _ParquetFiles(folder, layout.EPISODES_PATH, first_file=rows)
        self._rows_place = layout.file_place(rows)
        self._rows: list[dict[str, Any]] = []
        self._videos = {}
        for camera, shape in shapes.items():
            key = layout.IMAGES + camera
            number = self._next_file(layout.VIDEO_PATH, video_key=key)
            self._videos[camera] = CameraVideo(
                folder, key, fps=self.fps, shape=shape, first_file=number
            )

    def _next_file(self, template: str, **values: str) -> int:
        return 0 if self._before is None else self._before.next_file(template, **values)

    def add(self, reader: EpisodeReader) -> None:
        _check_cameras(reader, self._cameras)
        attributes, frames = reader.attributes, frames_of(reader, self._cameras, self.fps)
        where = f"episode {attributes.episode_id!r}"
        if (frames.action_kind == "commanded") != self._has_measured:
            raise InvalidInputError(
                f"{where}: got {frames.action_kind} actions; export episodes with commanded "
                "actions and those without into different datasets"
            )
        common_layout([self._tactile_layout, reader.tactile_layout], what=f"dataset, {where}")
        row: dict[str, Any] = {"episode_index": self._num_episodes, "length": len(frames)}
        row["tasks"] = [attributes.instruction or attributes.task]
        next_task = max(self._tasks.values(), default=-1) + 1
        task_index = self._tasks.setdefault(row["tasks"][0], next_task)
        columns = self._columns(frames, task_index, self._touch_samples(reader, frames))
        statistics = {name: value_statistics(column) for name, column in columns.items()}
        how: dict[str, Literal["remuxed", "encoded"]] = {}
        for camera in self._cameras:
            indices = frames.image_indices[camera]
            units, how[camera] = self._access_units(reader, camera, indices)
            place = self._videos[camera].append(units, where=f"{where}: {camera!r}")
            key = f"videos/{layout.IMAGES}{camera}"
            chunk_file = layout.file_place(place.file_number)
            row[f"{key}/chunk_index"], row[f"{key}/file_index"] = chunk_file
            row[f"{key}/from_timestamp"] = place.from_timestamp_s
            row[f"{key}/to_timestamp"] = place.to_timestamp_s
            sampled = sampled_images(reader, camera, indices)
            statistics[layout.IMAGES + camera] = image_statistics(sampled)
        file_number = self._data.append(_data_table(self._features, columns))
        row["data/chunk_index"], row["data/file_index"] = layout.file_place(file_number)
        row["dataset_from_index"] = self.num_frames
        row["dataset_to_index"] = self.num_frames + len(frames)
        for name, values in statistics.items():
            self._total[name] = combine(self._total.get(name), values)
            row.update({f"stats/{name}/{kind}": value.tolist() for kind, value in values.items()})
        row["meta/episodes/chunk_index"], row["meta/episodes/file_index"] = self._rows_place
        sidecar = layout.Sidecar(
            episode_index=self._num_episodes,
            content_sha256=reader.content_sha256,
            grid=frames.grid,
            action_kind=frames.action_kind,
            cameras=how,
            attributes=attributes,
        )
        name = layout.SIDECAR_PATH.format(episode_index=self._num_episodes)
        self._write(name, json.dumps(sidecar.model_dump(mode="json"), indent=2) + "\n")
        self._rows.append(row)
        if len(self._rows) == ROWS_AT_ONCE:
            self._write_rows()
        self.num_frames += len(frames)
        self._num_episodes += 1

    def _access_units(
        self, reader: EpisodeReader, camera: str, indices: np.ndarray
    ) -> tuple[list[bytes], Literal["remuxed", "encoded"]]:
        units = stored_units(reader, camera, indices)
        if units is not None:
            return units, "remuxed"
        blocks = np.split(indices, range(BLOCK_IMAGES, len(indices), BLOCK_IMAGES))
        images = (image for block in blocks for image in reader.images_at(camera, block))
        return encode_images(images, self.fps, VIDEO, GROUP_IMAGES), "encoded"

    def _touch_samples(self, reader: EpisodeReader, frames: EpisodeFrames) -> dict[str, np.ndarray]:
        if not self._num_samples:
            return {}
        touch = layout.touch_samples(reader, frames.columns[layout.STAMP], self._num_samples)
        excess = touch[layout.SAMPLES_COUNT] - self._num_samples
        self._num_left_out += int(excess.clip(0).sum())
        return touch

    def _columns(
        self, frames: EpisodeFrames, task_index: int, touch: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        frame_index = np.arange(len(frames), dtype=np.int64)
        columns = frames.columns | {
            **touch,
            "timestamp": (frame_index / self.fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full_like(frame_index, self._num_episodes),
            "index": self.num_frames + frame_index,
            "task_index": np.full_like(frame_index, task_index),
        }
        return {name: columns[name] for name in self._features if name in columns}

    def close(self) -> None:
        for video in self._videos.values():
            video.close()
        self._write_rows()
        self._data.close()
        self._episodes.close()

    def _write_rows(self) -> None:
        if self._rows:
            table = pa.Table.from_pylist(self._rows)
            if self._before is not None:
                self._before.check_columns(table.column_names)
            self._episodes.append(table)
            self._rows = []

    def result(self, present: tuple[str, ...]) -> DatasetExport:
        num_frames, num_episodes = self.num_frames, self._num_episodes
        if self._before is not None:
            num_frames -= self._before.num_frames
            num_episodes -= len(self._before.source.episodes)
        return DatasetExport(
            num_episodes, num_frames, present, self._num_left_out, self._cameras_left_out
        )

    def finish(self, repo_id: str, license_name: str | None) -> None:
        """Complete the files and write the metadata; raises StorageError if the write failed."""
        self.close()
        self._write_tasks()
        statistics = {
            name: {kind: value.tolist() for kind, value in values.items()}
            for name, values in self._total.items()
        }
        for name, content in ((layout.STATS_FILE, statistics), (layout.INFO_FILE, self._info())):
            self._write(name, json.dumps(content, indent=4, allow_nan=False) + "\n")
        with disk_errors(f"write the card of {self._folder}"):
            write_card(self._folder, repo_id=repo_id, license_name=license_name)

    def _write_tasks(self) -> None:
        """A table whose pandas index is the task's text."""
        kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "str")}
        described = [
            {"name": n, "field_name": n, "pandas_type": p, "numpy_type": d, "metadata": None}
            for n, (p, d) in kinds.items()
        ]
        header = {"index_columns": ["task"], "column_indexes": [], "columns": described}
        numbers = pa.array(np.array(list(self._tasks.values()), dtype=np.int64))
        texts = pa.array(list(self._tasks), pa.string())
        table = pa.Table.from_pydict({"task_index": numbers, "task": texts})
        path = self._folder / layout.TASKS_FILE
        with disk_errors(f"write {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(header)}), path)

    def _info(self) -> dict[str, Any]:
        known: dict[str, Any] = {} if self._before is None else self._before.info
        new = {
            "codebase_version": layout.CODEBASE_VERSION,
            "fps": self.fps,
            "features": self._features,
            "total_episodes": self._num_episodes,
            "total_frames": self.num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": layout.CHUNK_FILES,
            "data_files_size_in_mb": layout.DATA_FILE_MB,
            "video_files_size_in_mb": layout.VIDEO_FILE_MB,
            "data_path": layout.DATA_PATH,
            "video_path": layout.VIDEO_PATH if self._videos else None,
            "robot_type": "dextouch",
            "splits": {"train": f"0:{self._num_episodes}"},
        }
        counts = {key: new[key] for key in new if key.startswith(("total_", "splits"))}
        return new | known | counts

    def _write(self, name: str, text: str) -> None:
        path = self._folder / name
        with disk_errors(f"write {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)


def _num_samples(
    first: EpisodeReader,
    cameras: tuple[str, ...],
    fps: int,
    options: ExportOptions,
    before: ExistingDataset | None,
) -> int:
    """Touch samples that a frame has room for; 0 without any.

    It is as many as a frame of the first episode has, and half as many more as nominal rates give.
    """
    if before is not None:
        feature = before.info["features"].get(layout.SAMPLES)
        if (feature is None) == options.touch_samples:
            raise InvalidInputError(
                f"{before.source.folder}: its frames have {'no' if feature is None else 'all'} "
                f"touch samples; append {'without' if feature is None else 'with'} "
                "--touch-samples, or export into a new folder"
            )
        return int(feature["shape"][0]) if feature is not None else 0
    if not options.touch_samples:
        return 0
    rates_hz = [one.nominal_rate_hz for one in first.streams.values() if one.kind == "tactile"]
    if not rates_hz:
        raise InvalidInputError(
            f"episode {first.attributes.episode_id!r}: has no touch; export without --touch-samples"
        )
    t_ns = frames_of(first, cameras, fps).columns[layout.STAMP]
    most = int(layout.touch_counts(first, t_ns).max())
    return max(most, math.ceil(1.5 * max(rates_hz) / fps))


def _chosen_cameras(
    first: EpisodeReader, options: ExportOptions
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The cameras of a dataset, and those left out since they have no colours."""
    if options.cameras:
        return options.cameras, ()
    names = [name for name, stream in first.streams.items() if stream.kind == "image"]
    heads_first = sorted(names, key=lambda name: (name != "camera_head", name))
    colours = tuple(name for name in heads_first if _has_colours(first.streams[name]))
    return colours, tuple(name for name in heads_first if name not in colours)


def _has_colours(stream: StreamDescriptor) -> bool:
    return stream.dtype == "uint8" and stream.shape[2:] == (3,)


def _check_cameras(reader: EpisodeReader, cameras: tuple[str, ...]) -> None:
    images = [name for name, stream in reader.streams.items() if stream.kind == "image"]
    missing = [name for name in cameras if name not in images]
    if missing:
        raise InvalidInputError(
            f"episode {reader.attributes.episode_id!r}: has no camera {missing}, only {images}; "
            "choose some that all episodes have (--cameras)"
        )
    for name in cameras:
        dtype, shape = reader.streams[name].dtype, reader.streams[name].shape
        if not _has_colours(reader.streams[name]):
            raise ShapeError(
                f"camera {name!r}: got {dtype} {[*shape]}, expected uint8 [h, w, 3] of colours; "
                "leave it out (--cameras), or export the episode as MCAP"
            )
        height_px, width_px = shape[:2]
        if height_px % 2 or width_px % 2:
            raise ShapeError(
                f"camera {name!r}: got images of {height_px} x {width_px} pixels, expected even "
                "sides; LeRobot's players need 4:2:0 video"
            )
