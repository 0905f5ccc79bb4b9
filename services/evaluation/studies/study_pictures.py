"""The table of policies as a picture for a paper: imagined over real success, in three formats."""

from datetime import UTC, datetime
from typing import get_args

from dextouch.errors import UnknownNameError
from services.evaluation.reporting.policy_picture import Format, Rate, policy_picture
from services.evaluation.scores import REAL
from services.evaluation.studies.results import StudyDefinition, StudyResults
from services.evaluation.studies.study_figures import (
    StudyFigures,
    StudyRate,
    study_figures,
    study_rollouts,
    study_summary,
)


def picture(figures: StudyFigures, world: str, task: str, form: Format) -> bytes:
    """The picture of an imagined world, of one task or, with an empty name, of all.

    Policies of which too few rollouts are decided are left out, as from the agreement. Raises
    UnknownNameError if the study has no such world or task.
    """
    known = figures.summary
    if world not in known.worlds:
        raise UnknownNameError("imagined world of the study", world, list(known.worlds))
    if task and task not in known.tasks:
        raise UnknownNameError("task of the study", task, list(known.tasks))
    rates = {(one.world, one.task, one.policy): one for one in figures.rates}
    pairs: dict[str, list[tuple[Rate, Rate]]] = {name: [] for name in known.policies}
    for one in figures.rates:
        other = rates[world, one.task, one.policy]
        if one.world == REAL and task in {"", one.task} and None not in {one.rate, other.rate}:
            pairs[one.policy] += [(_values(one), _values(other))] * other.is_comparable
    title = f"{world}, {task.replace('_', ' ') or 'all tasks'}"
    return policy_picture(pairs, title, form)


def picture_name(world: str, task: str, form: Format) -> str:
    """Name of the file of a picture."""
    return f"policies {world} {task or 'all tasks'}.{form}"


def write_pictures(results: StudyResults) -> None:
    """Write pictures of all imagined worlds and tasks beside the results, in all formats."""
    folder = results.path.parent
    definition = StudyDefinition.model_validate(results.header.definition)
    summary = study_summary(folder.name, definition, results, datetime.now(UTC))
    rollouts = study_rollouts(definition, results)
    figures = study_figures(definition, results, rollouts, summary)
    for world in figures.summary.worlds:
        for task in (*figures.summary.tasks, *([""] * (len(figures.summary.tasks) > 1))):
            for form in get_args(Format):
                path = folder / picture_name(world, task, form)
                path.write_bytes(picture(figures, world, task, form))


def _values(rate: StudyRate) -> Rate:
    """The rate and its interval."""
    value = float(rate.rate or 0.0)
    return value, *(rate.interval or (value, value))
