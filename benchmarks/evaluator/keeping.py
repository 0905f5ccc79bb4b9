"""Results of the stage `evaluator` as lines of JSON, so that no rollout is made twice.

A row is known by what it is about: the digests of twin, world and judge, the task, the seed and
the policy. Arrays that other rows need (endings, images at the ends of chunks) lie beside the
file. A line that a killed run left unfinished is skipped.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dextouch.errors import CorruptDataError, StorageError

# What tells rows apart; fields that a kind of row does not have are left out.
KEY_FIELDS = (
    "kind", "twin", "world", "judge", "direct judge", "world without touch",
    "task", "seed", "policy",
)  # fmt: skip
Row = dict[str, Any]


def row_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a row is about."""
    return tuple(row.get(field) for field in KEY_FIELDS)


class KeptRows:
    """All rows of a file; rows that are added are written at once.

    Args:
        path: of the file; it and its folder are created with the first row.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows: dict[tuple[Any, ...], Row] = {}
        if path.is_file():
            for line in path.read_text(encoding="utf-8").splitlines():
                if (row := _parsed(line)) is not None:
                    self._rows[row_key(row)] = row

    def __len__(self) -> int:
        return len(self._rows)

    def get(self, **about: object) -> Row | None:
        """The row about something, None where there is none."""
        return self._rows.get(row_key(about))

    def add(self, rows: Iterable[Row]) -> None:
        """Write rows.

        Raises:
            StorageError: the file cannot be written.
        """
        new = [row for row in rows if row_key(row) not in self._rows]
        text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in new)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                # A line of a killed run may have no end yet.
                file.write(("\n" if file.tell() and not self._ends_well() else "") + text)
        except OSError as error:
            raise StorageError(
                f"results {self.path}: cannot be written ({error}); choose another --keep"
            ) from error
        self._rows |= {row_key(row): row for row in new}

    def _ends_well(self) -> bool:
        with self.path.open("rb") as file:
            file.seek(-1, 2)
            return file.read() == b"\n"


def _parsed(line: str) -> Row | None:
    try:
        row = json.loads(line)
    except json.JSONDecodeError:
        return None
    return row if isinstance(row, dict) and "kind" in row else None


def array_path(keep: Path, *, digests: Sequence[str], **about: object) -> Path:
    """Where the arrays of a rollout lie; `digests` are of every world that they come from."""
    digest = "-".join(one[:12] for one in digests)
    policy = str(about["policy"]).replace(" ", "_").replace("'", "")
    name = f"{about['task']}-{about['seed']}-{policy}.npz"
    return keep / "arrays" / str(about["kind"]) / digest / name


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    partial.replace(path)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays of `write_arrays`.

    Raises:
        CorruptDataError: a file that is not one of ours.
    """
    try:
        with np.load(path, allow_pickle=False) as kept:
            return {name: kept[name] for name in kept.files}
    except (OSError, ValueError) as error:
        raise CorruptDataError(f"arrays {path}: {error}; remove the file") from error
