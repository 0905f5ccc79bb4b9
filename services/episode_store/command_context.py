"""What all commands of `dextouch store` share: the store, parsed arguments, and what they print."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dextouch.data_folder import is_bucket_url, is_system_file
from dextouch.episodes import KINDS, EpisodeStore, Kind, check_id, local_folder
from dextouch.errors import InvalidInputError, NotFoundError

Outcome = tuple[dict[str, Any], int]


@dataclass(frozen=True)
class Context:
    """The store, its URL, and parsed arguments."""

    store: EpisodeStore
    url: str
    options: argparse.Namespace

    def kind_of(self, item_id: str) -> Kind:
        """Kind of an id: given by --kind, otherwise the one under which it exists.

        Raises NotFoundError: no such id; InvalidInputError: both kinds exist.
        """
        check_id(item_id)
        if self.options.kind:
            return self.options.kind
        root, exists = self.root, self.store.exists
        found = [
            kind
            for kind in KINDS
            if exists(item_id, kind=kind) or (root and (root / f"{kind}s" / item_id).is_dir())
        ]
        if not found:
            raise NotFoundError(
                f"{item_id!r}: not in the store {self.url}, neither episode nor recording"
            )
        if len(found) > 1:
            raise InvalidInputError(
                f"{item_id!r} is an episode and a recording; name one with --kind"
            )
        return found[0]

    def items(self) -> list[tuple[Kind, str]]:
        """Selected items: the given ids, otherwise all of the given kinds.

        A folder counts even without a commit record.
        """
        if self.options.ids:
            return [(self.kind_of(item_id), item_id) for item_id in self.options.ids]
        found: list[tuple[Kind, str]] = []
        for kind in KINDS if self.options.kind is None else (self.options.kind,):
            names = set(self.store.list(kind=kind))
            folder = None if self.root is None else self.root / f"{kind}s"
            if folder is not None and folder.is_dir():
                names |= {p.name for p in folder.iterdir() if not is_system_file(p.name)}
            found += [(kind, name) for name in sorted(names)]
        return found

    @property
    def root(self) -> Path | None:
        """The store's folder; None for one in a bucket."""
        return None if is_bucket_url(self.url) else local_folder(self.url)

    def need_local_root(self) -> Path:
        """The store's folder. Raises InvalidInputError: a store in a bucket."""
        if self.root is None:
            raise InvalidInputError(
                f"{self.options.command}: got the store {self.url}, expected one in a folder; copy "
                "it to a folder first, or use the versions of the bucket"
            )
        return self.root


def table(rows: list[tuple[str, ...]]) -> list[str]:
    """Format rows of text as lines with aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))] if rows else []
    return [
        "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
