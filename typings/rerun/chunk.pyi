from collections.abc import Iterator
from pathlib import Path
from typing import Any

class Chunk:
    entity_path: str
    is_static: bool
    timeline_names: list[str]
    def to_record_batch(self) -> Any: ...

class StoreEntry:
    recording_id: str

class RrdReader:
    def __init__(self, path: str | Path) -> None: ...
    def recordings(self) -> list[StoreEntry]: ...
    def stream(self, *, store: StoreEntry | None = None) -> Iterator[Chunk]: ...
