"""Parquet files of a dataset: typed columns, written per episode and read with size limits."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dextouch.bridges.lerobot.layout import Features, numbered_path
from dextouch.episodes import disk_errors
from dextouch.errors import CorruptDataError, LimitExceededError, NotFoundError

MAX_TABLE_BYTES = 1 << 31
MAX_TABLE_ROWS = 20_000_000


def data_table(features: Features, columns: Mapping[str, np.ndarray]) -> pa.Table:
    """Rows of the data files from columns [n, *shape]; every feature except video.

    A feature of shape [1] is a plain value, one of another axis a fixed list, one of several axes
    lists of lists.
    """
    table = {}
    for name, feature in features.items():
        if feature["dtype"] == "video":
            continue
        values = np.asarray(columns[name], dtype=feature["dtype"])
        shape = [] if feature["shape"] == [1] else feature["shape"]
        column = pa.array(values.reshape(-1))
        kind = column.type
        for size in reversed(shape):
            column = pa.FixedSizeListArray.from_arrays(column, size)
            kind = pa.list_(kind, size if len(shape) == 1 else -1)
        table[name] = column.cast(kind)
    return pa.Table.from_pydict(table)


class ParquetFiles:
    """Numbered parquet files of one kind; each table becomes a row group.

    Args:
        folder: root of the dataset.
        template: of the files' paths.
        file_bytes: size after which the next table starts a new file; without it none does.
    """

    def __init__(self, folder: Path, template: str, *, file_bytes: int = sys.maxsize) -> None:
        self._folder, self._template, self._file_bytes = folder, template, file_bytes
        self._path = folder
        self._writer: pq.ParquetWriter | None = None
        self._file_number = -1

    def append(self, table: pa.Table) -> int:
        """Write a table and return the number of its file.

        Raises:
            StorageError: the write failed.
        """
        with disk_errors(f"write a table of {self._folder}"):
            if self._writer is None or self._path.stat().st_size >= self._file_bytes:
                self.close()
                self._file_number += 1
                self._path = numbered_path(self._folder, self._template, self._file_number)
                self._writer = pq.ParquetWriter(self._path, table.schema, compression="snappy")
            self._writer.write_table(table)
        return self._file_number

    def close(self) -> None:
        """Complete the file that is open."""
        if self._writer is not None:
            with disk_errors(f"complete {self._path}"):
                self._writer.close()
            self._writer = None


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
