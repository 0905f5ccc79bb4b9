"""What `EpisodeStore` needs of the place where groups are kept; one class a kind of place."""

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
    """Committed groups by kind and id, and what is on its way to become one.

    What is committed never changes, and what is not committed is not seen.
    """

    @property
    def root(self) -> Path:
        """The folder of this machine that unfinished things lie in."""
        ...

    def writer(self, kind: Kind, attributes: Attributes, options: WriteOptions) -> EpisodeWriter:
        """A writer whose commit puts a group here; ConflictError if the id is taken."""
        ...

    def group(self, kind: Kind, item_id: str) -> GroupFiles:
        """The files of a committed group; NotFoundError if there is none."""
        ...

    def exists(self, kind: Kind, item_id: str) -> bool:
        """Whether an id is committed."""
        ...

    def revision(self, kind: Kind, item_id: str) -> int:
        """A number that changes when an id is deleted and written again."""
        ...

    def num_bytes(self, kind: Kind, item_id: str) -> int:
        """What a committed group takes there; NotFoundError if there is none."""
        ...

    def list(self, kind: Kind) -> list[str]:
        """Committed ids in order."""
        ...

    def delete(self, kind: Kind, item_id: str) -> None:
        """Make a group vanish."""
        ...

    def migrate(self, kind: Kind, item_id: str) -> bool:
        """Bring a group of an older format version over; False if it is of the current one."""
        ...

    def recover(self) -> builtins.list[RecoveredGroup]:
        """Complete what killed writers left behind, as far as they went."""
        ...

    def sweep(self) -> int:
        """Remove what nothing can be made of; how many things went comes back."""
        ...
