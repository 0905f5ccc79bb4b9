"""Reader of LeRobotDataset v3 folders of any origin, with validated metadata."""

import codecs
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.video import VideoSpan
from dextouch.data_folder import is_system_file
from dextouch.episodes import disk_errors
from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError, NotFoundError
from dextouch.schemas import first_problems

MAX_INFO_BYTES: Final = 1 << 24
MAX_SIDECAR_BYTES: Final = 1 << 22
MAX_EPISODES: Final = 1_000_000
MAX_EPISODE_FRAMES: Final = 1_000_000
MAX_TABLE_BYTES: Final = 1 << 31
MAX_TABLE_ROWS: Final = 20_000_000
_INDICES = ("chunk_index", "file_index")


class FeatureInfo(BaseModel):
    """One feature of `info.json`."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    dtype: str = Field(max_length=32)
    shape: tuple[int, ...] = Field(max_length=5)
    names: Any = None

    def numbers(self) -> tuple[int, ...]:
        """Shape of a row; images always as [height, width, channels]."""
        if self.dtype == "video" and len(self.shape) == 3 and self.shape[0] == 3 != self.shape[2]:
            return (self.shape[1], self.shape[2], 3)
        return self.shape

    def is_video(self) -> bool:
        """Whether it is a camera with colours."""
        shape = self.numbers()
        return self.dtype == "video" and shape[2:] == (3,) and min(shape) > 0


class DatasetInfo(BaseModel):
    """The fields of `info.json` that this reader uses."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    codebase_version: str = Field(max_length=32)
    # A whole number for LeRobot itself; others write the rate of their cameras, such as 29.97.
    fps: float = Field(ge=1, le=1000)
    features: dict[str, FeatureInfo] = Field(max_length=10_000)
    total_episodes: int = Field(ge=0, le=MAX_EPISODES)
    data_path: str = Field(max_length=512)
    video_path: str | None = Field(default=None, max_length=512)
    robot_type: str | None = None


@dataclass(frozen=True)
class EpisodeEntry:
    """One row of the table of episodes."""

    index: int
    length: int
    task: str
    row: dict[str, Any]


class LeRobotFolder:
    """A dataset on disk; only its metadata is read up front.

    Raises NotFoundError for a missing file of the metadata, InvalidInputError for another version
    of the format, CorruptDataError for damaged metadata, or paths that leave the folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info = _read_info(folder)
        tasks = _read_tasks(folder)
        self.episodes = _read_episodes(folder, self.info, tasks)
        self._table: tuple[Path, pa.Table] | None = None

    def columns(self, entry: EpisodeEntry, names: list[str]) -> dict[str, np.ndarray]:
        """Columns [n, *shape] of one episode by feature.

        Raises NotFoundError without the data file, CorruptDataError if that lacks frames in order.
        """
        path = self.data_file(entry)
        table = self._rows(path, entry)
        where = f"{path}: episode {entry.index}"
        if table.num_rows != entry.length:
            raise CorruptDataError(f"{where}: got {table.num_rows} frames, expected {entry.length}")
        order = _column_values(table, "frame_index", [1], where)
        if not np.array_equal(order, np.arange(entry.length)):
            raise CorruptDataError(f"{where}: frame_index does not count its frames from 0")
        columns = {}
        for name in names:
            feature = self.info.features[name]
            columns[name] = _column_values(table, name, feature.shape, where)
            if (got := columns[name].dtype.name) != feature.dtype:
                raise CorruptDataError(
                    f"{where}: column {name!r} is {got}, info.json declares {feature.dtype}"
                )
        return columns

    def sidecar(self, entry: EpisodeEntry) -> layout.Sidecar | None:
        """An episode's sidecar, None in a foreign dataset.

        Raises CorruptDataError for an invalid file.
        """
        name = layout.SIDECAR_PATH.format(episode_index=entry.index)
        path = layout.confined(self.folder, name)
        data = _small_file(path, MAX_SIDECAR_BYTES)
        if data is None:
            return None
        try:
            sidecar = layout.Sidecar.model_validate_json(data)
        except ValidationError as error:
            raise CorruptDataError(
                f"{path}: is not a description of an episode ({first_problems(error)}); remove "
                "it to import the frames as a dataset of other origin"
            ) from error
        if sidecar.episode_index != entry.index:
            raise CorruptDataError(
                f"{path}: got episode {sidecar.episode_index}, expected {entry.index}"
            )
        return sidecar

    def data_file(self, entry: EpisodeEntry) -> Path:
        """The parquet file with an episode's frames."""
        return self._path(self.info.data_path, entry, "data")

    def span(self, entry: EpisodeEntry, key: str) -> VideoSpan:
        """File and time span of an episode's images of one camera.

        Raises CorruptDataError if they are missing from the table of episodes.
        """
        if self.info.video_path is None:
            raise CorruptDataError(f"{self.folder}: has video features but no video_path")
        start = entry.row.get(f"videos/{key}/from_timestamp")
        if not isinstance(start, float) or not 0 <= start < 1e9:
            raise CorruptDataError(
                f"{self.folder}: episode {entry.index} does not specify where {key!r} "
                f"begins ({start})"
            )
        path = self._path(self.info.video_path, entry, f"videos/{key}", video_key=key)
        shape = self.info.features[key].numbers()
        return VideoSpan(path, start, entry.length, self.info.fps, shape)

    def _path(self, template: str, entry: EpisodeEntry, prefix: str, **values: str) -> Path:
        numbers = {n: entry.row.get(f"{prefix}/{n}") for n in _INDICES}
        places = {n: v for n, v in numbers.items() if isinstance(v, int) and v >= 0}
        if len(places) != len(numbers):
            raise CorruptDataError(
                f"{self.folder}: episode {entry.index} does not specify its file of {prefix!r}"
            )
        return layout.confined(self.folder, layout.fill_path(template, **places, **values))

    def _rows(self, path: Path, entry: EpisodeEntry) -> pa.Table:
        # Consecutive episodes usually share a file, so the last table is cached.
        if self._table is None or self._table[0] != path:
            wanted = [n for n, f in self.info.features.items() if f.dtype != "video"]
            self._table = path, _read_table(path, wanted)
        table = self._table[1]
        owners = _column_values(table, "episode_index", [1], str(path))
        rows = np.flatnonzero(owners == entry.index)
        if len(rows) and int(rows[-1]) - int(rows[0]) + 1 != len(rows):
            raise CorruptDataError(f"{path}: frames of episode {entry.index} are not contiguous")
        return table.slice(int(rows[0]) if len(rows) else 0, len(rows))


def _small_file(path: Path, max_bytes: int) -> bytes | None:
    with disk_errors(f"read {path}"):
        if not path.is_file():
            return None
        if path.stat().st_size > max_bytes:
            raise CorruptDataError(f"{path}: is larger than {max_bytes} bytes")
        # Editors of Windows begin text with a byte-order mark.
        return path.read_bytes().removeprefix(codecs.BOM_UTF8)


def _read_info(folder: Path) -> DatasetInfo:
    path = layout.confined(folder, layout.INFO_FILE)
    data = _small_file(path, MAX_INFO_BYTES)
    if data is None:
        raise NotFoundError(f"{path}: is missing; {folder} is not a LeRobot dataset")
    try:
        plain = json.loads(data)
        version = plain["codebase_version"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CorruptDataError(f"{path}: is not a valid dataset description ({error})") from error
    if not isinstance(version, str) or not version.startswith("v3."):
        raise InvalidInputError(
            f"{path}: got format {version!r}, expected v3.x; convert it with "
            "lerobot.scripts.convert_dataset_v21_to_v30"
        )
    try:
        return DatasetInfo.model_validate(plain)
    except ValidationError as error:
        raise CorruptDataError(
            f"{path}: is not a valid dataset description ({first_problems(error)})"
        ) from error


def _read_tasks(folder: Path) -> list[str]:
    path = layout.confined(folder, layout.TASKS_FILE)
    table = _read_table(path)
    # Older writers use the name that pandas gives an unnamed index column.
    text = next((n for n in ("task", "__index_level_0__") if n in table.column_names), None)
    if text is None or "task_index" not in table.column_names:
        raise CorruptDataError(
            f"{path}: got columns {table.column_names}, expected task_index, task"
        )
    return [str(row[text]) for row in _table_rows(table, path)]


def _episode_rows(folder: Path, info: DatasetInfo) -> Iterator[dict[str, Any]]:
    videos = [name for name, feature in info.features.items() if feature.dtype == "video"]
    places = [f"{p}/{i}" for p in ("data", *(f"videos/{v}" for v in videos)) for i in _INDICES]
    starts = [f"videos/{name}/from_timestamp" for name in videos]
    wanted = ["episode_index", "length", "tasks", *places, *starts]
    tables = folder / "meta" / "episodes"
    found = sorted(tables.glob("*/*.parquet"))
    paths = [path for path in found if not is_system_file(path.relative_to(tables))]
    if not paths:
        raise NotFoundError(f"{folder}: meta/episodes holds no table of episodes")
    for path in paths:
        inside = layout.confined(folder, str(path.relative_to(folder)))
        yield from _table_rows(_read_table(inside, wanted), path)


def _read_episodes(folder: Path, info: DatasetInfo, tasks: list[str]) -> tuple[EpisodeEntry, ...]:
    entries: list[EpisodeEntry] = []
    for row in _episode_rows(folder, info):
        index, length = row.get("episode_index"), row.get("length")
        if not isinstance(index, int) or not isinstance(length, int):
            raise CorruptDataError(f"{folder}: an episode has no index or no length ({row})")
        if index != len(entries) or not 1 <= length <= MAX_EPISODE_FRAMES:
            raise CorruptDataError(
                f"{folder}: got episode {index} of {length} frames, expected episode "
                f"{len(entries)} of 1 … {MAX_EPISODE_FRAMES} frames"
            )
        said = row.get("tasks") or tasks[:1] or [""]
        text = str(said[0]) if isinstance(said, list) else str(said)
        entries.append(EpisodeEntry(index, length, text, row))
    if len(entries) != info.total_episodes:
        raise CorruptDataError(
            f"{folder}: table lists {len(entries)} episodes, info.json says {info.total_episodes}; "
            "the dataset was not finished"
        )
    return tuple(entries)


def _read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Columns of a parquet file within the size limits; absent ones are omitted."""
    if not path.is_file():
        raise NotFoundError(f"{path}: is missing from the dataset")
    try:
        with pq.ParquetFile(path, memory_map=True) as file:
            groups = [file.metadata.row_group(g) for g in range(file.metadata.num_row_groups)]
            size, rows = sum(g.total_byte_size for g in groups), file.metadata.num_rows
            if size > MAX_TABLE_BYTES or rows > MAX_TABLE_ROWS:
                raise LimitExceededError(
                    f"{path}: got {rows} rows in {size} bytes, expected at most {MAX_TABLE_ROWS} "
                    f"rows in {MAX_TABLE_BYTES} bytes; split the dataset into smaller files"
                )
            present = file.schema_arrow.names
            wanted = present if columns is None else [c for c in columns if c in present]
            return file.read(columns=wanted, use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise CorruptDataError(
            f"{path}: is not a complete parquet file ({error}); copy the dataset again"
        ) from error


def _table_rows(table: pa.Table, path: Path) -> list[dict[str, Any]]:
    try:
        return table.to_pylist()
    except (pa.ArrowException, ValueError, OverflowError) as error:
        raise CorruptDataError(f"{path}: holds invalid values ({error})") from error


def _column_values(table: pa.Table, name: str, shape: Sequence[int], where: str) -> np.ndarray:
    """A column as an array [n, *shape]; shape [1] gives [n]."""
    if name not in table.column_names:
        raise CorruptDataError(f"{where}: has no column {name!r}, which info.json declares")
    try:
        column: Any = table.column(name).combine_chunks()
        # Some writers wrap arrays in a type of their own.
        column = getattr(column, "storage", column)
        lengths: list[int] = []
        num_empty = int(column.null_count)
        while hasattr(column, "value_lengths"):
            # Rows of unequal length would shift all that follow.
            sizes = np.unique(column.value_lengths().to_numpy(zero_copy_only=False))
            lengths.append(int(sizes[0]) if len(sizes) == 1 and num_empty == 0 else -1)
            column = column.flatten()
            num_empty += int(column.null_count)
        values = column.to_numpy(zero_copy_only=False)
    except pa.ArrowException as error:
        raise CorruptDataError(f"{where}: column {name!r} is damaged ({error})") from error
    row_shape = [] if list(shape) == [1] else [*shape]
    if table.num_rows and (num_empty or lengths not in (row_shape, [*shape])):
        raise CorruptDataError(
            f"{where}: column {name!r} holds rows of {lengths or 'single values'} with "
            f"{num_empty} empty values, expected {list(shape)} and none"
        )
    if values.dtype.kind not in "biuf":
        raise CorruptDataError(f"{where}: column {name!r} does not hold numbers ({column.type})")
    return values.reshape(table.num_rows, *row_shape)
