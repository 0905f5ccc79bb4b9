"""Rubrics: criteria with points by which a rollout is scored, the same for people and the twin."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pydantic import Field, ValidationError, model_validator

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel

BUNDLED: Final = Path(__file__).with_name("rubrics.toml")
_NAME: Final = r"^[a-z][a-z0-9_]{0,63}$"


class Criterion(FrozenModel):
    """One statement about a rollout that holds or does not.

    `requires` names criteria without which it gives no points. A `latched` criterion holds if it
    was ever reached, any other only if it holds at the end. `milestone` is the corresponding
    milestone of the twin.
    """

    name: str = Field(pattern=_NAME)
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

    @property
    def is_seen_by_twin(self) -> bool:
        """Whether every criterion has a milestone of the twin."""
        return all(criterion.milestone is not None for criterion in self.criteria)

    def score(self, holds: Mapping[str, bool], *, is_inconsistent: bool = False) -> float:
        """Score of a rollout in 0 … 1: its points as a share of the maximum.

        Args:
            holds: whether each criterion holds, for all of them.
            is_inconsistent: whether it shows something physically impossible (once or more: the
                penalty counts once).

        Raises:
            UnknownNameError: another rubric's criterion.
            InvalidInputError: a criterion without a mark.
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
        met: dict[str, bool] = {}
        for criterion in self.criteria:
            met[criterion.name] = holds[criterion.name] and all(map(met.get, criterion.requires))
        points = sum(criterion.points for criterion in self.criteria if met[criterion.name])
        points -= self.penalty * is_inconsistent
        return min(max(points / self.max_points, 0.0), 1.0)

    def holds_in_twin(self, event_times_s: Mapping[str, float]) -> dict[str, bool]:
        """Whether each criterion holds in a rollout of the twin, by the times of its milestones.

        The twin records when a milestone was first reached, so every criterion counts as latched.

        Raises:
            InvalidInputError: a criterion without a milestone, which only people can mark.
        """
        if unseen := [one.name for one in self.criteria if one.milestone is None]:
            raise InvalidInputError(
                f"rubric: {', '.join(unseen)} has no milestone of the twin; expected raters' marks"
            )
        return {one.name: one.milestone in event_times_s for one in self.criteria}


def read_rubrics(path: Path | None = None) -> dict[str, Rubric]:
    """Rubrics of a TOML file by task; by default the package's: the paper's and the twin's tasks.

    Raises:
        InvalidInputError: unreadable, or no valid rubric in a table.
    """
    path = BUNDLED if path is None else path
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"rubrics {path}: cannot be read ({error})") from error
    rubrics = {}
    for task, table in tables.items():
        try:
            rubrics[task] = Rubric.model_validate(table)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in (task, *first["loc"]))
            raise InvalidInputError(f"rubrics {path}: {where}: {first['msg']}") from error
    return rubrics


def rubric_of(task: str, rubrics: Mapping[str, Rubric]) -> Rubric:
    """Rubric of a task.

    Raises:
        UnknownNameError: no rubric for it.
    """
    if task not in rubrics:
        raise UnknownNameError("rubric of task", task, list(rubrics))
    return rubrics[task]
