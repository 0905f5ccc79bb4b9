"""Parquet files of a dataset: typed columns, written per episode and read with size limits."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dextouch.bridges.lerobot.layout import (
    DATA_FILE_MB,
    DATA_PATH,
    Features,
    file_place,
    fill_path,
)
from dextouch.episodes import disk_errors
from dextouch.errors import CorruptDataError, LimitExceededError, NotFoundError

MAX_TABLE_BYTES = 1 << 31
MAX_TABLE_ROWS = 20_000_000


def column_type(dtype: str, shape: Sequence[int]) -> pa.DataType:
    """Arrow type of a feature: a plain value, a fixed list, or lists of lists."""
    item = pa.from_numpy_dtype(np.dtype(dtype))
    if list(shape) == [1]:
        return item
    if len(shape) == 1:
        return pa.list_(item, shape[0])
    for _ in shape:
        item = pa.list_(item)
    return item


def data_schema(features: Features) -> pa.Schema:
    """Schema of the data files: every feature except video."""
    return pa.schema(
        [
            (name, column_type(feature["dtype"], feature["shape"]))
            for name, feature in features.items()
            if feature["dtype"] != "video"
        ]
    )


def nested(values: np.ndarray, *, fixed: bool) -> pa.Array:
    """An array [n, …] as a column of n plain values, fixed lists or lists of lists."""
    column = pa.array(np.ascontiguousarray(values).reshape(-1))
    if values.ndim == 2 and fixed:
        return pa.FixedSizeListArray.from_arrays(column, values.shape[1])
    for axis in range(values.ndim - 1, 0, -1):
        rows = int(np.prod(values.shape[:axis]))
        offsets = np.arange(rows + 1, dtype=np.int32) * values.shape[axis]
        column = pa.ListArray.from_arrays(pa.array(offsets), column)
    return column


class DataFiles:
    """The data files of a dataset: one row group per episode, a new file above a size limit.

    Args:
        folder: root of the dataset.
        features: of the dataset.
        file_bytes: size after which no episode is added to a file.
    """

    def __init__(
        self, folder: Path, features: Features, *, file_bytes: int = DATA_FILE_MB << 20
    ) -> None:
        self._folder, self._features, self._file_bytes = folder, features, file_bytes
        self._schema = data_schema(features)
        self._path = folder
        self._writer: pq.ParquetWriter | None = None
        self._file_number = -1

    def append(self, columns: Mapping[str, np.ndarray]) -> int:
        """Write one episode's columns [n, *shape] by feature and return its file number.

        Raises:
            StorageError: the write failed.
        """
        with disk_errors("write the frames of an episode"):
            if self._writer is None or self._path.stat().st_size >= self._file_bytes:
                self._start_file()
            assert self._writer is not None  # noqa: S101 (just opened)
            rows = {}
            for name in self._schema.names:
                dtype, shape = self._features[name]["dtype"], self._features[name]["shape"]
                values = np.asarray(columns[name], dtype=dtype)
                row_shape = () if list(shape) == [1] else tuple(shape)
                rows[name] = nested(values.reshape(len(values), *row_shape), fixed=True)
            self._writer.write_table(pa.Table.from_pydict(rows, schema=self._schema))
        return self._file_number

    def close(self) -> None:
        """Complete the file that is open."""
        if self._writer is not None:
            with disk_errors(f"complete {self._path}"):
                self._writer.close()
            self._writer = None

    def _start_file(self) -> None:
        self.close()
        self._file_number += 1
        chunk, file = file_place(self._file_number)
        self._path = self._folder / fill_path(DATA_PATH, chunk_index=chunk, file_index=file)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = pq.ParquetWriter(self._path, self._schema, compression="snappy")


class EpisodeRows:
    """The table of episodes: one row each, arrays as nested lists; written in batches of 100.

    Args:
        path: of the file.
    """

    BUFFERED = 100

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: list[Mapping[str, Any]] = []
        self._writer: pq.ParquetWriter | None = None

    def append(self, row: Mapping[str, Any]) -> None:
        """Add an episode; every row has the columns of the first.

        Raises:
            StorageError: the write failed.
        """
        self._rows.append(row)
        if len(self._rows) >= self.BUFFERED:
            self._flush()

    def close(self) -> None:
        """Write the remaining rows and close the file."""
        self._flush()
        if self._writer is not None:
            with disk_errors(f"complete {self._path}"):
                self._writer.close()
            self._writer = None

    def _flush(self) -> None:
        if not self._rows:
            return
        columns = {}
        for name, first in self._rows[0].items():
            values = [row[name] for row in self._rows]
            is_array = isinstance(first, np.ndarray)
            columns[name] = nested(np.stack(values), fixed=False) if is_array else pa.array(values)
        table = pa.Table.from_pydict(columns)
        with disk_errors(f"write {self._path}"):
            if self._writer is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._writer = pq.ParquetWriter(self._path, table.schema, compression="snappy")
            self._writer.write_table(table)
        self._rows.clear()


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write `tasks.parquet`: a table whose pandas index is the task's text.

    Raises:
        StorageError: the write failed.
    """
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "str")}
    described = [
        {"name": n, "field_name": n, "pandas_type": p, "numpy_type": d, "metadata": None}
        for n, (p, d) in kinds.items()
    ]
    header = {"index_columns": ["task"], "column_indexes": [], "columns": described}
    numbers = pa.array(np.arange(len(tasks), dtype=np.int64))
    table = pa.Table.from_pydict(
        {"task_index": numbers, "task": pa.array(list(tasks), pa.string())}
    )
    with disk_errors(f"write {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(header)}), path)


def read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Read columns of a parquet file within the size limits; absent columns are omitted.

    Raises:
        NotFoundError: no such file.
        CorruptDataError: not a parquet file, or a damaged or truncated one.
        LimitExceededError: it declares more than the limits of this reader.
    """
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


def table_rows(table: pa.Table, *, where: str) -> list[dict[str, Any]]:
    """Convert a small table to plain rows.

    Raises:
        CorruptDataError: values that cannot be represented.
    """
    try:
        return table.to_pylist()
    except (pa.ArrowException, ValueError, OverflowError) as error:
        raise CorruptDataError(f"{where}: holds invalid values ({error})") from error


def column_values(table: pa.Table, name: str, shape: Sequence[int], *, where: str) -> np.ndarray:
    """A column as an array [n, *shape]; shape [1] gives [n].

    Raises:
        CorruptDataError: no such column, missing values, rows of another shape, or values that are
            not numbers.
    """
    if name not in table.column_names:
        raise CorruptDataError(f"{where}: has no column {name!r}, which info.json declares")
    try:
        return _plain(table, name, shape, where)
    except pa.ArrowException as error:
        raise CorruptDataError(f"{where}: column {name!r} is damaged ({error})") from error


def _plain(table: pa.Table, name: str, shape: Sequence[int], where: str) -> np.ndarray:
    column: Any = table.column(name).combine_chunks()
    # Some writers wrap arrays in a type of their own.
    column = getattr(column, "storage", column)
    row_shape = () if list(shape) == [1] else tuple(shape)
    lengths: list[int] = []
    num_empty = int(column.null_count)
    while hasattr(column, "value_lengths"):
        # Rows of unequal length would shift all that follow.
        sizes = np.unique(column.value_lengths().to_numpy(zero_copy_only=False))
        lengths.append(int(sizes[0]) if len(sizes) == 1 and num_empty == 0 else -1)
        column = column.flatten()
        num_empty += int(column.null_count)
    if table.num_rows and (num_empty or lengths not in ([*row_shape], [*shape])):
        raise CorruptDataError(
            f"{where}: column {name!r} holds rows of {lengths or 'single values'} with "
            f"{num_empty} empty values, expected {list(shape)} and none"
        )
    values = column.to_numpy(zero_copy_only=False)
    if values.dtype.kind not in "biuf":
        raise CorruptDataError(f"{where}: column {name!r} does not hold numbers ({column.type})")
    return values.reshape(table.num_rows, *row_shape)
