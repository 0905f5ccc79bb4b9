"""What a study's page and its papers show: rates, agreement, single rollouts, and pictures."""

import itertools
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, get_args

import structlog
from pydantic import AwareDatetime

from dextouch.command_line import write_result
from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from services.evaluation.agreement import FIGURES
from services.evaluation.closed_loop import example_pairs, title_of
from services.evaluation.rendering import UNDEFINED
from services.evaluation.reporting import write_report
from services.evaluation.reporting.pictures import (
    MAX_MOVING,
    PredictionPicture,
    ReportPictures,
    episode_pair,
)
from services.evaluation.reporting.policy_picture import Format, Rate, policy_picture
from services.evaluation.reporting.sections import latex_tables
from services.evaluation.scores import (
    LEAST_DECIDED,
    REAL,
    VAGUE_R,
    ClosedLoopReport,
    RolloutFailure,
    RolloutScore,
    undefined_by,
)
from services.evaluation.studies.results import (
    KEPT_FOLDER,
    PlannedRollout,
    StudyResults,
    planned_rollout_of,
    planned_rollouts_of,
    rollout_episode_id,
    study_report,
)

logger = structlog.get_logger(__name__)

# From this difference of success on, two worlds disagree about a start.
DISAGREEMENT: Final = 0.5
MEANINGS: Final = {
    name: text.replace("{share}", f"{LEAST_DECIDED:.0%}")
    for name, text in tomllib.loads(
        Path(__file__).with_name("meanings.toml").read_text(encoding="utf-8")
    ).items()
}
REPORT_FILE: Final = "report.json"
TABLES_FILE: Final = "tables.tex"


class StudySummary(FrozenModel):
    """A study in the list; `problem` is why its results cannot be read, and there is no more."""

    name: str
    title: str = ""
    tasks: tuple[str, ...] = ()
    worlds: tuple[str, ...] = ()
    policies: tuple[str, ...] = ()
    num_rollouts: int = 0
    num_done: int = 0
    num_failed: int = 0
    is_running: bool = False
    changed_at: AwareDatetime
    problem: str | None = None


class StudyRate(FrozenModel):
    """Success rate of a policy in a task of a world, with its 95 % Wilson interval.

    It is None without decided rollouts: the success classifier leaves `num_unreliable` undecided,
    for `reasons`; they count in no rate; `is_comparable` if it decided enough. `num_missing` have
    no result yet, and `num_disagreements` starts have another outcome than in the real world.
    """

    world: str
    task: str
    policy: str
    rate: float | None
    interval: tuple[float, float] | None
    num_finished: int
    num_failed: int
    num_missing: int
    num_unreliable: int
    is_comparable: bool = True
    reasons: tuple[str, ...] = ()
    num_disagreements: int = 0


class StudyAgreement(FrozenModel):
    """Agreement of an imagined world with the real one; `task` is empty for all tasks at once.

    `is_vague`: Pearson's interval is too wide to tell a faithful world from a poor one.
    `undefined`: what to show for figures that are None.
    """

    world: str
    task: str
    figures: dict[str, float | None]
    intervals: dict[str, tuple[float, float] | None]
    is_vague: bool
    undefined: str
    chance: float | None
    num_policies: int
    num_starts: int
    comments: tuple[str, ...] = ()


class StudyRollout(FrozenModel):
    """One rollout of a study; `real_…` are those of the same start and policy.

    Ids are those under which the study keeps its rollouts; None where it keeps none.
    """

    world: str
    task: str
    policy: str
    seed: int
    repeat: int
    success: bool | None = None
    probability: float | None = None
    unreliable: str | None = None
    error: str | None = None
    real_success: bool | None = None
    disagrees: bool = False
    episode_id: str | None = None
    real_episode_id: str | None = None


class StudyFigures(FrozenModel):
    """All figures of a study, those of unfinished ones so far."""

    summary: StudySummary
    rates: tuple[StudyRate, ...]
    agreement: tuple[StudyAgreement, ...]
    num_disagreements: int
    meanings: dict[str, str] = MEANINGS


def study_summary(name: str, results: StudyResults, changed_at: datetime) -> StudySummary:
    """What the list of studies shows of one whose results can be read."""
    definition, outcomes = results.definition, results.outcomes.values()
    return StudySummary(
        name=name,
        title=definition.name,
        tasks=definition.tasks,
        worlds=tuple(definition.imagined),
        policies=tuple(definition.policies),
        num_rollouts=definition.num_rollouts,
        num_done=len(outcomes),
        num_failed=sum(isinstance(one, RolloutFailure) for one in outcomes),
        changed_at=changed_at,
    )


def study_rollouts(results: StudyResults) -> tuple[StudyRollout, ...]:
    """All rollouts with a result, those first that disagree with the real world most."""
    definition = results.definition
    real = {
        (planned.task, planned.seed, planned.policy): outcome.success
        for planned, outcome in results.outcomes.items()
        if planned.world == REAL and isinstance(outcome, RolloutScore)
    }
    found = [
        _rollout(planned, outcome, real, results, is_kept=definition.keep_rollouts)
        for planned in planned_rollouts_of(definition)
        if (outcome := results.outcomes.get(planned)) is not None
    ]
    # Stable, so that the order of the report stays among equals.
    return tuple(sorted(found, key=_unlike))


def _unlike(rollout: StudyRollout) -> tuple[bool, bool, float]:
    sureness = abs((rollout.probability or 0.0) - 0.5)
    return not rollout.disagrees, rollout.unreliable is not None, -sureness * rollout.disagrees


def _rollout(
    planned: PlannedRollout,
    outcome: RolloutScore | RolloutFailure,
    real: dict[tuple[str, int, str], bool],
    results: StudyResults,
    *,
    is_kept: bool,
) -> StudyRollout:
    if isinstance(outcome, RolloutFailure):
        return StudyRollout(**planned._asdict(), error=f"{outcome.error}: {outcome.message}")
    real_one = planned._replace(world=REAL, repeat=0)
    in_reality = real.get((planned.task, planned.seed, planned.policy))
    return StudyRollout(
        **planned._asdict(),
        success=outcome.success,
        probability=outcome.probability,
        unreliable=outcome.cannot_tell,
        real_success=in_reality,
        disagrees=in_reality is not None and in_reality != outcome.success,
        episode_id=rollout_episode_id(results.header, planned) if is_kept else None,
        real_episode_id=(
            rollout_episode_id(results.header, real_one)
            if is_kept and in_reality is not None
            else None
        ),
    )


def study_figures(
    results: StudyResults, rollouts: tuple[StudyRollout, ...], summary: StudySummary
) -> StudyFigures:
    """Rates and agreement, with the intervals of `ClosedLoopReport`."""
    report = study_report(results.definition, results)
    rates = tuple(_rates(report, rollouts))
    agreement = [one for world in report.imagined_worlds for one in _agreement(report, world)]
    return StudyFigures(
        summary=summary,
        rates=rates,
        agreement=tuple(agreement),
        num_disagreements=sum(one.num_disagreements for one in rates),
    )


def _rates(report: ClosedLoopReport, rollouts: tuple[StudyRollout, ...]) -> Iterator[StudyRate]:
    missing = Counter(
        (one.world, one.task, one.policy) for one in report.failures if one.error == "NotRunYet"
    )
    reasons: dict[tuple[str, str, str], dict[str, None]] = {}
    unlike: dict[tuple[str, str, str], dict[int, list[bool]]] = {}
    for one in rollouts:
        place = (one.world, one.task, one.policy)
        if one.unreliable is not None:
            reasons.setdefault(place, {})[one.unreliable] = None
        if one.real_success is not None:
            unlike.setdefault(place, {}).setdefault(one.seed, []).append(one.disagrees)
    worlds = (REAL, *report.imagined_worlds)
    for task, policy, world in itertools.product(report.tasks, report.policies, worlds):
        place, figures = (world, task, policy), report.figures(world, task, policy)
        yield StudyRate(
            world=world,
            task=task,
            policy=policy,
            rate=None if figures["rate"] == UNDEFINED else figures["rate"],
            interval=figures.get("interval"),
            num_finished=figures["rollouts"],
            num_failed=figures["failed"] - missing[place],
            num_missing=missing[place],
            num_unreliable=figures.get("undecided", 0),
            is_comparable=figures.get("comparable", True),
            reasons=tuple(reasons.get(place, ())),
            num_disagreements=sum(
                sum(repeats) >= DISAGREEMENT * len(repeats)
                for repeats in unlike.get(place, {}).values()
            ),
        )


def _agreement(report: ClosedLoopReport, world: str) -> Iterator[StudyAgreement]:
    alone = replace(report, imagined_worlds=(world,)).to_report()
    tasks = alone["agreement"]
    if alone["agreement_of_all_tasks"]:
        num_policies = max(found["num_policies"] for found in tasks.values())
        num_starts = sum(found["num_starts"] for found in tasks.values())
        counted = {"num_policies": num_policies, "num_starts": num_starts}
        tasks = tasks | {"": alone["agreement_of_all_tasks"] | counted}
    for task, found in tasks.items():
        known = {name: None if isinstance(v, str) else v for name, v in found.items()}
        intervals: dict[str, Any] = {n: known.get(f"{n}_interval") for n in FIGURES}
        yield StudyAgreement(
            world=world,
            task=task,
            figures={name: known[name] for name in FIGURES},
            intervals={name: one and tuple(one) for name, one in intervals.items()},
            is_vague=bool(intervals["pearson"]) and intervals["pearson"][0] < VAGUE_R,
            undefined=undefined_by(found["num_policies"]),
            chance=known.get("pearson_chance"),
            num_policies=found["num_policies"],
            num_starts=found["num_starts"],
            comments=tuple(alone["comments"].get(task, ())),
        )


def kept_pairs(
    report: ClosedLoopReport, world: str, results: StudyResults
) -> tuple[PredictionPicture, ...]:
    """The example pairs of a study of those rollouts that its folder keeps, whole ones only."""
    store = EpisodeStore(str(results.path.with_name(KEPT_FOLDER)))
    found = list[PredictionPicture]()
    for pair in example_pairs(report, world).values():
        ids = [rollout_episode_id(results.header, planned_rollout_of(score)) for score in pair]
        if len(found) < MAX_MOVING and all(map(store.exists, ids)):
            try:
                found.append(episode_pair(title_of(pair), store.open(ids[0]), store.open(ids[1])))
            except DexTouchError as error:
                logger.warning("pair_not_shown", pair=title_of(pair), reason=error.message)
    return tuple(found)


def write_reports(results: StudyResults, json_path: Path | None) -> dict[str, Any]:
    """Write all reports beside the results of a study, finished or not, and return the figures.

    The figures are those of report.json; they are written to `json_path`, too (`write_result`).
    """
    folder = results.path.parent
    definition = results.definition
    report = study_report(definition, results)
    figures = report.to_report()
    figures["study"] = {"name": definition.name, "digests": results.header.digests}
    for path in (folder / REPORT_FILE, json_path):
        write_result(path, figures, allow_nan=False)
    for world in definition.imagined:
        others = tuple(name for name in definition.imagined if name != world)
        page = replace(report, imagined_worlds=(world, *others)).to_report()
        title = f"{definition.name}: {world} and the real world"
        pictures = ReportPictures(moving=kept_pairs(report, world, results))
        write_report(page | {"title": title}, pictures, folder / f"report {world}.html")
    (folder / TABLES_FILE).write_text(latex_tables(report), encoding="utf-8")
    return figures


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
    summary = study_summary(folder.name, results, datetime.now(UTC))
    figures = study_figures(results, study_rollouts(results), summary)
    for world in figures.summary.worlds:
        for task in (*figures.summary.tasks, *([""] * (len(figures.summary.tasks) > 1))):
            for form in get_args(Format):
                path = folder / picture_name(world, task, form)
                path.write_bytes(picture(figures, world, task, form))


def _values(rate: StudyRate) -> Rate:
    value = float(rate.rate or 0.0)
    return value, *(rate.interval or (value, value))
