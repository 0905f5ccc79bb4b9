from collections.abc import Iterator
from pathlib import Path
from typing import Any

class Chunk:
    entity_path: str
    is_static: bool
    timeline_names: list[str]
    def to_record_batch(self) -> Any: ...

class RrdReader:
    def __init__(self, path: str | Path) -> None: ...
    def stream(self) -> Iterator[Chunk]: ...
