"""Interface of storage backends, which keep the groups of an `EpisodeStore`."""

import builtins
from pathlib import Path
from typing import Protocol, runtime_checkable

from dextouch.episodes.format import Kind
from dextouch.episodes.sources import GroupFiles
from dextouch.episodes.staged_group import Attributes
from dextouch.episodes.staging_recovery import RecoveredGroup
from dextouch.episodes.write_options import WriteOptions
from dextouch.episodes.writer import EpisodeWriter


@runtime_checkable
class Storage(Protocol):
    """Committed groups by kind and id, and stages of unfinished ones.

    Committed groups are immutable, and uncommitted ones are invisible.
    """

    @property
    def root(self) -> Path:
        """Local folder of unfinished groups."""
        ...

    def writer(self, kind: Kind, attributes: Attributes, options: WriteOptions) -> EpisodeWriter:
        """Writer of a new group; ConflictError if the id is taken."""
        ...

    def group(self, kind: Kind, item_id: str) -> GroupFiles:
        """Files of a committed group; NotFoundError if there is none."""
        ...

    def exists(self, kind: Kind, item_id: str) -> bool:
        """Whether an id is committed."""
        ...

    def revision(self, kind: Kind, item_id: str) -> int:
        """A number that changes when an id is deleted and written again."""
        ...

    def num_bytes(self, kind: Kind, item_id: str) -> int:
        """Size of a committed group; NotFoundError if there is none."""
        ...

    def list(self, kind: Kind) -> list[str]:
        """Sorted committed ids."""
        ...

    def delete(self, kind: Kind, item_id: str) -> None:
        """Delete a group."""
        ...

    def migrate(self, kind: Kind, item_id: str) -> bool:
        """Upgrade a group of an older format version; False if it is current."""
        ...

    def recover(self) -> builtins.list[RecoveredGroup]:
        """Commit the stages of terminated writers, as far as they were written."""
        ...

    def sweep(self) -> int:
        """Remove stages that cannot be recovered and return their number."""
        ...
