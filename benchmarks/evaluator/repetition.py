"""Whether a run of the evaluator repeats an earlier one: each figure within a stated tolerance.

Figures of few starts scatter, those of policies most. The tolerance of a difference is therefore at
least its own 95 % half width, the root of the sum of squares of those of both figures.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ValidationError

from benchmarks.evaluator.drawn import Line
from benchmarks.figures import Requirement, at_most
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError

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

    Raises:
        NotFoundError: no such file.
        CorruptDataError: no such report.
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

    Raises:
        InvalidInputError: no line in common.
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
        apart = None if line.value is None else abs(line.value - other.value)
        what = f"{line.task}: {line.what}, apart from {other.value:.3f} before"
        sampling = math.hypot(_half_width(line.interval), _half_width(other.interval))
        bound = max(TOLERANCES[other.unit], sampling)
        found.append(at_most(what, apart, bound, line.unit))
    return found


def _half_width(interval: tuple[float, float] | None) -> float:
    return 0.0 if interval is None else (interval[1] - interval[0]) / 2
