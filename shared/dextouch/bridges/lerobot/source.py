"""Reader of LeRobotDataset folders (v3 and v2) of any origin, with validated metadata."""

import codecs
import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dextouch.bridges.import_recording import remedy, whole_text
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
# Of the decoded values of one file, and what a text takes beside its bytes.
MAX_TABLE_BYTES: Final = 1 << 30
TEXT_OVERHEAD_BYTES: Final = 64
MAX_TABLE_ROWS: Final = 20_000_000
MAX_LINES_BYTES: Final = 1 << 28
# Bytes of one encoded image.
MAX_IMAGE_BYTES: Final = 1 << 26
_IMAGES_AT_ONCE = 8
_PHYSICAL_BYTES = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 8, "FLOAT": 4, "DOUBLE": 8}
_INDICES = ("chunk_index", "file_index")
# Where the images of a feature are that the table has no column of; the first is that of v3.
_IMAGE_PATHS = (
    "images/{image_key}/episode-{episode_index:06d}/frame-{frame_index:06d}",
    "images/{image_key}/episode_{episode_index:06d}/frame_{frame_index:06d}",
)
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tiff")


class FeatureInfo(BaseModel):
    """One feature of `info.json`."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    dtype: str = Field(max_length=32)
    shape: tuple[int, ...] = Field(max_length=5)
    names: Any = None
    info: Any = None
    video_info: Any = None

    def numbers(self) -> tuple[int, ...]:
        """Shape of a row; images always as [height, width, channels]."""
        first, last = (self.shape[0], self.shape[-1]) if len(self.shape) == 3 else (0, 0)
        if self.is_camera() and first in {1, 3} and last not in {1, 3}:
            return (self.shape[1], self.shape[2], first)
        return self.shape

    def is_camera(self) -> bool:
        """Whether its values are images, in a video or one by one."""
        return self.dtype in {"video", "image"}

    def about_video(self) -> dict[str, Any]:
        """What it says of its video, such as `video.fps`; v2 has two names for it."""
        found = self.info or self.video_info
        return found if isinstance(found, dict) else {}

    def is_depth(self) -> bool:
        """Whether its images are depth maps."""
        about = self.about_video()
        return bool(about.get("is_depth_map", about.get("video.is_depth_map", False)))

    def component_names(self) -> tuple[str, ...]:
        """Names of the numbers of a row, empty if it has none or others than numbers."""
        names = self.names
        while isinstance(names, dict) and len(names) == 1:
            names = next(iter(names.values()))
        if isinstance(names, dict) and all(isinstance(v, int) for v in names.values()):
            names = sorted(names, key=lambda name: names[name])
        if isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
            names = names[0]
        if len(self.shape) != 1 or not isinstance(names, list) or len(names) != self.shape[0]:
            return ()
        return tuple(whole_text(name)[:128] for name in names)

    def has_colours(self) -> bool:
        """Whether it is a camera with colours."""
        shape = self.numbers()
        return self.is_camera() and shape[2:] == (3,) and min(shape) > 0 and not self.is_depth()


class DatasetInfo(BaseModel):
    """The fields of `info.json` that this reader uses."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    codebase_version: str = Field(max_length=32)
    # A whole number for LeRobot itself; others write the rate of their cameras, such as 29.97.
    fps: float = Field(ge=1, le=1000)
    features: dict[str, FeatureInfo] = Field(max_length=10_000)
    total_episodes: int = Field(ge=0, le=MAX_EPISODES)
    total_frames: int | None = None
    total_tasks: int | None = None
    chunks_size: int = Field(default=layout.CHUNK_FILES, ge=1, le=1_000_000)
    data_path: str = Field(max_length=512)
    video_path: str | None = Field(default=None, max_length=512)
    robot_type: str | None = None

    @property
    def has_file_per_episode(self) -> bool:
        """Whether it is v2, with a data file and videos of its own for each episode."""
        return self.codebase_version.startswith("v2.")


@dataclass(frozen=True)
class EpisodeEntry:
    """One row of the table of episodes."""

    index: int
    length: int
    tasks: tuple[str, ...]
    row: dict[str, Any]

    @property
    def task(self) -> str:
        """Its first task."""
        return self.tasks[0]


class LeRobotFolder:
    """A dataset on disk; only its metadata is read up front.

    Raises NotFoundError for a missing file of the metadata, InvalidInputError for another version
    of the format, CorruptDataError for damaged metadata, or paths that leave the folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info = _read_info(folder)
        self.tasks = _read_tasks(folder, self.info)
        self.episodes = _read_episodes(folder, self.info, self.tasks)
        self._table: tuple[Path, pa.Table, dict[int, tuple[int, int]]] | None = None

    def columns(self, entry: EpisodeEntry, names: list[str]) -> dict[str, np.ndarray]:
        """Columns [n, *shape] of one episode by feature.

        Raises NotFoundError without the data file, CorruptDataError if that lacks frames in order.
        """
        columns = {}
        for name in names:
            columns[name] = self.numbers(entry, name)
            if (got := columns[name].dtype.name) != self.info.features[name].dtype:
                raise CorruptDataError(
                    f"{self.data_file(entry)}: episode {entry.index}: column {name!r} is {got}, "
                    f"info.json declares {self.info.features[name].dtype}"
                )
        return columns

    def numbers(self, entry: EpisodeEntry, name: str) -> np.ndarray:
        """One feature's column [n, *shape] of an episode, whatever its type; as `columns`."""
        path = self.data_file(entry)
        return _column_values(
            self.rows(entry), name, self.info.features[name].shape, f"{path}: episode {entry.index}"
        )

    def rows(self, entry: EpisodeEntry) -> pa.Table:
        """All columns of an episode but those of images; raises as `columns`."""
        path = self.data_file(entry)
        where = f"{path}: episode {entry.index}"
        table, start, count = self._place(path, entry)
        if count != entry.length:
            raise CorruptDataError(f"{where}: got {count} frames, expected {entry.length}")
        part = table.slice(start, count)
        order = _column_values(part, "frame_index", [1], where)
        if not np.array_equal(order, np.arange(entry.length)):
            raise CorruptDataError(f"{where}: frame_index does not count its frames from 0")
        return part

    def texts(self, entry: EpisodeEntry, name: str) -> list[object]:
        """One feature's values of an episode as Python objects; raises as `columns`."""
        rows, path = self.rows(entry), self.data_file(entry)
        if name not in rows.column_names:
            raise CorruptDataError(f"{path}: has no column {name!r}, which info.json declares")
        try:
            return rows.column(name).to_pylist()
        except (pa.ArrowException, ValueError) as error:
            raise CorruptDataError(f"{path}: column {name!r} is damaged ({error})") from error

    def images(self, entry: EpisodeEntry, name: str) -> Iterator[bytes]:
        """Encoded images of an episode, one for each frame: from the data file or files of images.

        Raises NotFoundError for a missing file, CorruptDataError for other values than images,
        LimitExceededError for an image of more than MAX_IMAGE_BYTES.
        """
        path = self.data_file(entry)
        _, start, _ = self._place(path, entry)
        values: Iterator[object] = iter([None] * entry.length)
        if name in pq.read_schema(path).names:
            values = _image_values(path, name, start, entry.length)
        for index, value in enumerate(values):
            fields = value if isinstance(value, dict) else {"bytes": value}
            data, said = fields.get("bytes"), fields.get("path")
            if isinstance(data, str):
                data, said = None, data
            if data is None:
                data = self._image_file(entry, name, index, said)
            if not isinstance(data, bytes):
                raise CorruptDataError(f"{path}: column {name!r} holds no images ({type(data)})")
            yield data

    def _image_file(self, entry: EpisodeEntry, name: str, index: int, said: object) -> bytes:
        usual = [
            layout.fill_path(one, image_key=name, episode_index=entry.index, frame_index=index)
            for one in _IMAGE_PATHS
        ]
        named = [said] if isinstance(said, str) and said else []
        tried = [*named, *(one + suffix for one in usual for suffix in _IMAGE_SUFFIXES)]
        for one in tried:
            data = _small_file(layout.confined(self.folder, one), MAX_IMAGE_BYTES)
            if data is not None:
                return data
        raise NotFoundError(
            f"{self.folder}: episode {entry.index}: image {index} of {name!r} is missing; "
            f"expected it in the data file or as {tried[0]}"
        )

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
        shape = (*self.info.features[key].numbers()[:2], 3)
        if self.info.has_file_per_episode:
            path = self._path(self.info.video_path, entry, "", video_key=key)
            return VideoSpan(path, 0.0, entry.length, self.info.fps, shape)
        start = entry.row.get(f"videos/{key}/from_timestamp")
        if not isinstance(start, int | float) or not 0 <= start < 1e9:
            raise CorruptDataError(
                f"{self.folder}: episode {entry.index} does not specify where {key!r} "
                f"begins ({start})"
            )
        path = self._path(self.info.video_path, entry, f"videos/{key}", video_key=key)
        return VideoSpan(path, float(start), entry.length, self.info.fps, shape)

    def _path(self, template: str, entry: EpisodeEntry, prefix: str, **values: str) -> Path:
        if self.info.has_file_per_episode:
            chunk, index = entry.index // self.info.chunks_size, entry.index
            path = layout.fill_path(template, episode_chunk=chunk, episode_index=index, **values)
            return layout.confined(self.folder, path)
        numbers = {n: entry.row.get(f"{prefix}/{n}") for n in _INDICES}
        places = {n: v for n, v in numbers.items() if isinstance(v, int) and v >= 0}
        if len(places) != len(numbers):
            raise CorruptDataError(
                f"{self.folder}: episode {entry.index} does not specify its file of {prefix!r}"
            )
        return layout.confined(self.folder, layout.fill_path(template, **places, **values))

    def _place(self, path: Path, entry: EpisodeEntry) -> tuple[pa.Table, int, int]:
        """The table of a data file, and first row and number of rows of an episode."""
        # Consecutive episodes usually share a file, so the last table is cached.
        if self._table is None or self._table[0] != path:
            images = {name for name, feature in self.info.features.items() if feature.is_camera()}
            table = _read_table(path, leave_out=images)
            owners = _column_values(table, "episode_index", [1], str(path))
            starts = np.flatnonzero(np.diff(owners, prepend=owners[:1] - 1))
            runs = zip(owners[starts].tolist(), starts.tolist(), strict=True)
            ends = [*starts[1:].tolist(), len(owners)]
            places: dict[int, tuple[int, int]] = {}
            for (episode, start), end in zip(runs, ends, strict=True):
                if episode in places:
                    raise CorruptDataError(
                        f"{path}: frames of episode {episode} are not contiguous"
                    )
                places[episode] = (start, end - start)
            self._table = path, table, places
        _, table, places = self._table
        return table, *places.get(entry.index, (0, 0))


def _image_values(path: Path, name: str, start: int, count: int) -> Iterator[object]:
    """A column's values of `count` rows from `start`, in bounded memory."""
    try:
        with pq.ParquetFile(path) as file:
            sizes = [file.metadata.row_group(g).num_rows for g in range(file.num_row_groups)]
            stops = np.cumsum(sizes)
            groups = np.flatnonzero((stops > start) & (stops - sizes < start + count))
            row = int(stops[groups[0]]) - sizes[groups[0]] if len(groups) else 0
            for batch in file.iter_batches(
                _IMAGES_AT_ONCE, row_groups=groups.tolist(), columns=[name], use_threads=False
            ):
                low, high = max(0, start - row), min(batch.num_rows, start + count - row)
                row += batch.num_rows
                if low < high:
                    part = batch.column(0).slice(low, high - low)
                    if part.nbytes > (high - low) * MAX_IMAGE_BYTES:
                        raise LimitExceededError(
                            f"{path}: images of {name!r} are larger than {MAX_IMAGE_BYTES} bytes"
                        )
                    yield from part.to_pylist()
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CorruptDataError(f"{path}: column {name!r} is damaged ({error})") from error


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
    if not isinstance(version, str) or not version.startswith(("v3.", "v2.")):
        raise InvalidInputError(
            f"{path}: got format {version!r}, expected v3.x or v2.x; convert it with the release "
            "of lerobot that reads it"
        )
    try:
        return DatasetInfo.model_validate(plain)
    except ValidationError as error:
        raise CorruptDataError(
            f"{path}: is not a valid dataset description ({first_problems(error)})"
        ) from error


def _json_lines(folder: Path, name: str) -> list[dict[str, Any]]:
    """Objects of a file of v2 with one on each line."""
    path = layout.confined(folder, name)
    data = _small_file(path, MAX_LINES_BYTES)
    if data is None:
        raise NotFoundError(f"{path}: is missing from the dataset")
    try:
        rows = [json.loads(line) for line in data.splitlines() if line.strip()]
    except (ValueError, RecursionError) as error:
        raise CorruptDataError(f"{path}: holds a line that is no JSON ({error})") from error
    if not all(isinstance(row, dict) for row in rows):
        raise CorruptDataError(f"{path}: expected a JSON object on each line")
    return rows


def _read_tasks(folder: Path, info: DatasetInfo) -> dict[int, str]:
    """Tasks by number."""
    text: str | None = "task"
    if info.has_file_per_episode:
        path = folder / layout.TASKS_LINES
        rows = _json_lines(folder, layout.TASKS_LINES)
    else:
        path = layout.confined(folder, layout.TASKS_FILE)
        table = _read_table(path)
        # Older writers use the name that pandas gives an unnamed index column.
        text = next((n for n in ("task", "__index_level_0__") if n in table.column_names), None)
        if text is None or "task_index" not in table.column_names:
            raise CorruptDataError(
                f"{path}: got columns {table.column_names}, expected task_index, task"
            )
        rows = _table_rows(table, path)
    tasks: dict[int, str] = {}
    for row in rows:
        number, said = row.get("task_index"), row.get(text or "")
        if not isinstance(number, int) or said is None or number in tasks:
            raise CorruptDataError(f"{path}: got {row}, expected a task_index of its own and task")
        tasks[number] = whole_text(said)
    return tasks


def _episode_rows(folder: Path, info: DatasetInfo) -> Iterator[dict[str, Any]]:
    if info.has_file_per_episode:
        yield from _json_lines(folder, layout.EPISODES_LINES)
        return
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


def _read_episodes(
    folder: Path, info: DatasetInfo, tasks: dict[int, str]
) -> tuple[EpisodeEntry, ...]:
    entries: dict[int, EpisodeEntry] = {}
    for row in _episode_rows(folder, info):
        index, length = row.get("episode_index"), row.get("length")
        if not isinstance(index, int) or not isinstance(length, int):
            raise CorruptDataError(f"{folder}: an episode has no index or no length ({row})")
        is_new = 0 <= index < MAX_EPISODES and index not in entries
        if not is_new or not 1 <= length <= MAX_EPISODE_FRAMES:
            raise CorruptDataError(
                f"{folder}: got episode {index} of {length} frames, expected every episode once, "
                f"of 1 … {MAX_EPISODE_FRAMES} frames"
            )
        said = row.get("tasks") or list(tasks.values())[:1] or [""]
        texts = tuple(map(whole_text, said if isinstance(said, list) else [said]))
        entries[index] = EpisodeEntry(index, length, texts, row)
    if len(entries) != info.total_episodes:
        raise CorruptDataError(
            f"{folder}: table lists {len(entries)} episodes, info.json says {info.total_episodes}; "
            "the dataset was not finished"
        )
    return tuple(entries[index] for index in sorted(entries))


def _read_table(
    path: Path, columns: Sequence[str] | None = None, *, leave_out: Collection[str] = ()
) -> pa.Table:
    """Columns of a parquet file within the size limits; absent ones are omitted."""
    if not path.is_file():
        raise NotFoundError(f"{path}: is missing from the dataset")
    try:
        schema = pq.read_metadata(path).schema
        leaves = [schema.column(index) for index in range(len(schema))]
        texts = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY"]
        # Repeated texts stay one, whatever their number.
        with pq.ParquetFile(path, memory_map=True, read_dictionary=texts) as file:
            present = file.schema_arrow.names
            requested = present if columns is None else columns
            wanted = [c for c in requested if c in present and c not in leave_out]
            # Columns of lists and structures have a path that goes on after their name.
            starts = tuple(f"{column}." for column in wanted)
            chosen = [k for k, leaf in enumerate(leaves) if f"{leaf.path}.".startswith(starts)]
            tables, size = [], 0
            for number in range(file.num_row_groups):
                # Damaged statistics raise here; below they would end the process.
                next(file.iter_batches(1, row_groups=[number], columns=wanted), None)
                group = file.metadata.row_group(number)
                size += sum(_decoded_bytes(group.column(k), leaves[k]) for k in chosen)
                _check_size(path, file.metadata.num_rows, size)
                table = file.read_row_group(number, columns=wanted, use_threads=False)
                size += sum(_repeated_bytes(column) for column in table.columns)
                _check_size(path, file.metadata.num_rows, size)
                tables.append(table)
            return pa.concat_tables(tables) if tables else file.read(columns=wanted)
    except (pa.ArrowException, OSError, UnicodeError) as error:
        raise CorruptDataError(
            f"{path}: is not a complete parquet file ({error}); {remedy(path)}"
        ) from error


def _decoded_bytes(part: pq.ColumnChunkMetaData, leaf: pq.ColumnSchema) -> int:
    """Bytes of a part of a column in memory, without the repetitions of texts."""
    width = _PHYSICAL_BYTES.get(part.physical_type, leaf.length)
    if width:
        return part.num_values * width
    # What a text without a dictionary has in the file is what it has in memory.
    return part.total_uncompressed_size + part.num_values * TEXT_OVERHEAD_BYTES


def _check_size(path: Path, rows: int, size: int) -> None:
    if size > MAX_TABLE_BYTES or rows > MAX_TABLE_ROWS:
        raise LimitExceededError(
            f"{path}: got {rows} rows that need {size} bytes, expected at most {MAX_TABLE_ROWS} "
            f"rows in {MAX_TABLE_BYTES} bytes; split the dataset into smaller files"
        )


def _repeated_bytes(column: object) -> int:
    """Bytes of the texts in an array, each counted as often as it occurs."""
    array: Any = column
    parts = getattr(array, "chunks", None)
    if parts is None and hasattr(array, "dictionary"):
        indices = array.indices.drop_null().to_numpy()
        # The reader of parquet does not look.
        if len(indices) and not 0 <= indices.min() <= indices.max() < len(array.dictionary):
            raise pa.ArrowInvalid("a text is not in the dictionary")
        counts = np.bincount(indices, minlength=len(array.dictionary))
        lengths = pc.binary_length(array.dictionary).fill_null(0).to_numpy(zero_copy_only=False)
        return int(counts.astype(np.int64) @ lengths.astype(np.int64))
    if parts is None and hasattr(array, "flatten"):
        # Of lists their values, of structures one array for each field.
        flat = array.flatten()
        parts = flat if isinstance(flat, list) else [flat]
    return sum(_repeated_bytes(part) for part in parts or ())


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
