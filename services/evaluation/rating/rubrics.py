"""Rubrics of tasks: criteria that raters judge, and the score of a rollout that meets some."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems

BUNDLED: Final = Path(__file__).with_name("rubrics.toml")


class Criterion(FrozenModel):
    """One statement about a rollout that holds or does not.

    `requires` names criteria without which it gives no points. A `latched` criterion holds if it
    was ever reached, any other only if it holds at the end. `milestone` is the corresponding
    milestone of the twin.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,63}$")
    points: float = Field(gt=0, le=100, allow_inf_nan=False)
    description: FreeText = Field(min_length=1, max_length=500)
    requires: tuple[str, ...] = ()
    latched: bool = True
    milestone: str | None = None


class Rubric(FrozenModel):
    """Criteria of a task, and the points that a physical inconsistency costs an imagined rollout.

    Prerequisites of a criterion come before it.
    """

    criteria: tuple[Criterion, ...] = Field(min_length=1, max_length=20)
    penalty: float = Field(default=0.5, ge=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _is_ordered(self) -> "Rubric":
        known: list[str] = []
        for criterion in self.criteria:
            if criterion.name in known:
                raise ValueError(f"criterion {criterion.name!r} is given twice")
            if missing := [name for name in criterion.requires if name not in known]:
                raise ValueError(
                    f"criterion {criterion.name!r} requires {missing[0]!r}, expected one of the "
                    f"criteria before it ({', '.join(known) or 'none'})"
                )
            known.append(criterion.name)
        return self

    @property
    def max_points(self) -> float:
        """Points of a rollout that meets every criterion."""
        return sum(criterion.points for criterion in self.criteria)

    def score(self, holds: Mapping[str, bool | float], *, is_inconsistent: bool = False) -> float:
        """Score of a rollout in 0 … 1: its points as a share of the maximum.

        `holds` is whether each criterion holds, or with what probability: a criterion is then as
        probable as the least probable one that it requires. What is physically impossible costs the
        penalty once. Raises UnknownNameError for another rubric's criterion, and InvalidInputError
        if one has no mark.
        """
        names = [criterion.name for criterion in self.criteria]
        for name in holds:
            if name not in names:
                raise UnknownNameError("criterion", name, names)
        if missing := [name for name in names if name not in holds]:
            raise InvalidInputError(
                f"marks: no mark for {', '.join(missing)}; expected one for each of "
                f"{', '.join(names)}"
            )
        met: dict[str, float] = {}
        for criterion in self.criteria:
            required = (met[name] for name in criterion.requires)
            met[criterion.name] = min(holds[criterion.name], *required, 1.0)
        points = sum(criterion.points * met[criterion.name] for criterion in self.criteria)
        points -= self.penalty * is_inconsistent
        return min(max(points / self.max_points, 0.0), 1.0)

    def score_by_milestones(self, reached: Mapping[str, float]) -> float | None:
        """Score by whether each milestone was reached, or with what probability.

        None where a criterion has no milestone, or it is unknown whether one was reached.
        """
        known = {
            one.name: reached[one.milestone]
            for one in self.criteria
            if one.milestone is not None and one.milestone in reached
        }
        return self.score(known) if len(known) == len(self.criteria) else None


_RUBRICS: Final = TypeAdapter(dict[str, Rubric])


def read_rubrics(path: Path | None = None) -> dict[str, Rubric]:
    """Rubrics of a TOML file by task; by default the package's: the paper's and the twin's tasks.

    Raises InvalidInputError if it is unreadable, or a table holds no valid rubric.
    """
    path = BUNDLED if path is None else path
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"rubrics {path}: cannot be read ({error})") from error
    try:
        return _RUBRICS.validate_python(tables)
    except ValidationError as error:
        raise InvalidInputError(f"rubrics {path}: {first_problems(error)}") from error


def rubric_of(task: str, rubrics: Mapping[str, Rubric]) -> Rubric:
    """Rubric of a task; raises UnknownNameError if it has none."""
    if task not in rubrics:
        raise UnknownNameError("rubric of task", task, list(rubrics))
    return rubrics[task]
