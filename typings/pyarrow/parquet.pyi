from pathlib import Path
from types import TracebackType

from pyarrow import Schema, Table

class RowGroupMetaData:
    total_byte_size: int
    num_rows: int

class FileMetaData:
    num_rows: int
    num_row_groups: int
    def row_group(self, i: int) -> RowGroupMetaData: ...

class ParquetFile:
    metadata: FileMetaData
    schema_arrow: Schema
    def __init__(self, source: Path, *, memory_map: bool = ...) -> None: ...
    def read(self, columns: list[str] | None = ..., use_threads: bool = ...) -> Table: ...
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
