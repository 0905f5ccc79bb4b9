"""Results of the stage `evaluator` as lines of JSON, so that no rollout is computed twice.

A row is identified by the digests of twin, world and judge, the task, the seed and the policy; of
a policy with a mistake also by the digest of the mistakes.
Arrays that other rows need (endings, images at the ends of chunks) are stored next to the file. A
line that a killed run left incomplete is skipped.

A run repeats an earlier one if each figure is within a tolerance. Figures of few starts scatter,
those of policies most: the tolerance of a difference is at least its own 95 % half width, the root
of the sum of squares of those of both figures.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ValidationError

from benchmarks.evaluator.drawn import Line
from benchmarks.figures import Requirement, at_most
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError, StorageError

# Fields that identify a row; a kind of row may lack some of them.
KEY_FIELDS = (
    "kind", "twin", "world", "judge", "direct judge", "world without touch", "mistakes",
    "task", "seed", "policy",
)  # fmt: skip
Row = dict[str, Any]


def row_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Identity of a row."""
    return tuple(row.get(field) for field in KEY_FIELDS)


class KeptRows:
    """All rows of a file, which is created with the first; added rows are written at once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows: dict[tuple[Any, ...], Row] = {}
        if path.is_file():
            for line in path.read_text(encoding="utf-8").splitlines():
                # A killed run may have left a part of a line.
                with suppress(json.JSONDecodeError):
                    row = json.loads(line)
                    self._rows[row_key(row)] = row

    def __len__(self) -> int:
        return len(self._rows)

    def get(self, **about: object) -> Row | None:
        """The row with this identity, or None."""
        return self._rows.get(row_key(about))

    def add(self, rows: Iterable[Row]) -> None:
        """Write rows; raises StorageError if the file cannot be written."""
        new = [row for row in rows if row_key(row) not in self._rows]
        text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in new)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                # A killed run may have left a line without a line break.
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


def array_path(keep: Path, *, digests: Sequence[str], **about: object) -> Path:
    """Path of a rollout's arrays; `digests` are those of all worlds that they depend on."""
    known = [*digests, str(about["mistakes"])] if "mistakes" in about else digests
    digest = "-".join(one[:12] for one in known)
    policy = str(about["policy"]).replace(" ", "_").replace("'", "")
    name = f"{about['task']}-{about['seed']}-{policy}.npz"
    return keep / "arrays" / str(about["kind"]) / digest / name


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    partial.replace(path)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read arrays written by `write_arrays`.

    Raises CorruptDataError for a file that is not one of ours.
    """
    try:
        with np.load(path, allow_pickle=False) as kept:
            return {name: kept[name] for name in kept.files}
    except (OSError, ValueError) as error:
        raise CorruptDataError(f"arrays {path}: {error}; remove the file") from error


# Smallest tolerances by unit: of areas under the curve, correlations, rates and the like, and of
# decibels. Figures in other units scatter too much to be compared.
TOLERANCES: Final = {"": 0.08, "dB": 1.0}


class _EarlierLine(BaseModel):
    task: str
    what: str
    value: float | None
    interval: tuple[float, float] | None = None
    unit: str = ""


class _Run(BaseModel):
    lines: tuple[_EarlierLine, ...]


Earlier = Mapping[tuple[str, str], _EarlierLine]


def read_lines(path: Path) -> Earlier:
    """Lines of the `evaluator.json` of an earlier run, by task and name.

    Raises NotFoundError for no such file, and CorruptDataError for no such report.
    """
    if not path.is_file():
        raise NotFoundError(f"evaluator: no file {path} to compare with; see --repeats")
    try:
        run = _Run.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise CorruptDataError(
            f"evaluator: {path} is not the evaluator.json of an earlier run ({error})"
        ) from error
    return {(line.task, line.what): line for line in run.lines}


def repetition(lines: Sequence[Line], earlier: Earlier) -> list[Requirement]:
    """Difference of each figure that both runs have, with its tolerance.

    Raises InvalidInputError without a line in common.
    """
    if not any((line.task, line.what) in earlier for line in lines):
        raise InvalidInputError(
            f"evaluator: none of {len(lines)} lines is among the {len(earlier)} of the earlier "
            "run; compare runs of the same tasks"
        )
    found: list[Requirement] = []
    for line in lines:
        other = earlier.get((line.task, line.what))
        if other is None or other.value is None or other.unit not in TOLERANCES:
            continue
        difference = None if line.value is None else abs(line.value - other.value)
        what = f"{line.task}: {line.what}, apart from {other.value:.3f} before"
        sampling = math.hypot(_half_width(line.interval), _half_width(other.interval))
        bound = max(TOLERANCES[other.unit], sampling)
        found.append(at_most(what, difference, bound, line.unit))
    return found


def _half_width(interval: tuple[float, float] | None) -> float:
    return 0.0 if interval is None else (interval[1] - interval[0]) / 2
