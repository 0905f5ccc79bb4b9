from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from pyarrow import RecordBatch, Schema, Table

class ColumnChunkMetaData:
    path_in_schema: str
    total_uncompressed_size: int
    physical_type: str
    num_values: int

class ColumnSchema:
    path: str
    physical_type: str
    length: int

class ParquetSchema:
    def column(self, i: int) -> ColumnSchema: ...
    def __len__(self) -> int: ...

class RowGroupMetaData:
    total_byte_size: int
    num_rows: int
    num_columns: int
    def column(self, i: int) -> ColumnChunkMetaData: ...

class FileMetaData:
    num_rows: int
    num_row_groups: int
    schema: ParquetSchema
    def row_group(self, i: int) -> RowGroupMetaData: ...

class ParquetFile:
    metadata: FileMetaData
    num_row_groups: int
    schema_arrow: Schema
    def __init__(
        self, source: Path, *, memory_map: bool = ..., read_dictionary: list[str] = ...
    ) -> None: ...
    def read(self, columns: list[str] | None = ..., use_threads: bool = ...) -> Table: ...
    def read_row_group(
        self, i: int, columns: list[str] | None = ..., use_threads: bool = ...
    ) -> Table: ...
    def iter_batches(
        self,
        batch_size: int = ...,
        row_groups: list[int] | None = ...,
        columns: list[str] | None = ...,
        use_threads: bool = ...,
    ) -> Iterator[RecordBatch]: ...
    def close(self) -> None: ...
    def __enter__(self) -> ParquetFile: ...
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

class ParquetWriter:
    def __init__(self, where: Path, schema: Schema, *, compression: str = ...) -> None: ...
    def write_table(self, table: Table) -> None: ...
    def close(self) -> None: ...

def write_table(table: Table, where: Path) -> None: ...
def read_metadata(where: Path) -> FileMetaData: ...
def read_schema(where: Path) -> Schema: ...
