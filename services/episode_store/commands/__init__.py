"""Commands of `dextouch store`, and what they share: the store, its arguments, and output."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dextouch.data_folder import is_system_file
from dextouch.episodes import KINDS, EpisodeStore, Kind, check_id, local_folder
from dextouch.errors import InvalidInputError, NotFoundError

EXIT_DAMAGED = 1
_SIZES = ("bytes", "kB", "MB", "GB", "TB")

Outcome = tuple[dict[str, Any], int]


@dataclass(frozen=True)
class Context:
    """Store, parsed arguments, and the function for output."""

    store: EpisodeStore
    url: str
    options: argparse.Namespace
    say: Callable[[str], None]

    def kind_of(self, item_id: str) -> Kind:
        """Kind of an id: given by --kind, otherwise the one under which it exists.

        Raises:
            NotFoundError: no such id.
            InvalidInputError: both kinds exist.
        """
        check_id(item_id)
        if self.options.kind:
            return self.options.kind
        found = [kind for kind in KINDS if self._is_there(kind, item_id)]
        if not found:
            raise NotFoundError(
                f"{item_id!r}: not in the store {self.url}, neither episode nor recording"
            )
        if len(found) > 1:
            raise InvalidInputError(
                f"{item_id!r} is an episode and a recording; name one with --kind"
            )
        return found[0]

    def _is_there(self, kind: Kind, item_id: str) -> bool:
        if self.store.exists(item_id, kind=kind):
            return True
        root = self.local_root()
        return root is not None and (root / f"{kind}s" / item_id).is_dir()

    def items(self) -> list[tuple[Kind, str]]:
        """Selected items: the given ids, otherwise all of the given kinds.

        A folder counts even without a commit record.
        """
        if self.options.ids:
            return [(self.kind_of(item_id), item_id) for item_id in self.options.ids]
        root = self.local_root()
        found: list[tuple[Kind, str]] = []
        for kind in KINDS if self.options.kind is None else (self.options.kind,):
            names = set(self.store.list(kind=kind))
            folder = None if root is None else root / f"{kind}s"
            if folder is not None and folder.is_dir():
                names |= {p.name for p in folder.iterdir() if not is_system_file(p.name)}
            found += [(kind, name) for name in sorted(names)]
        return found

    def local_root(self) -> Path | None:
        """The store's folder; None for one in a bucket."""
        return None if self.url.startswith("s3://") else local_folder(self.url)

    def need_local_root(self) -> Path:
        """The store's folder.

        Raises:
            InvalidInputError: a store in a bucket.
        """
        root = self.local_root()
        if root is None:
            raise InvalidInputError(
                f"{self.options.command}: got the store {self.url}, expected one in a folder; copy "
                "it to a folder first, or use the versions of the bucket"
            )
        return root


def readable_size(num_bytes: int) -> str:
    """Format a size with three digits and a unit."""
    size, unit = float(num_bytes), 0
    while size >= 999.5 and unit < len(_SIZES) - 1:
        size, unit = size / 1000, unit + 1
    return f"{num_bytes} bytes" if unit == 0 else f"{size:.3g} {_SIZES[unit]}"


def table(rows: list[tuple[str, ...]]) -> list[str]:
    """Format rows of text as lines with aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))] if rows else []
    return [
        "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
