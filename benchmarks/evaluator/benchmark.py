"""The stage `evaluator`: policies in the twin and in imagination, and the agreement of both."""

import argparse
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from benchmarks.evaluator.drawn import Line, Rolled
from benchmarks.evaluator.keeping import KeptRows, Row, read_lines, repetition
from benchmarks.evaluator.lines import VERDICTS, TaskFigures
from benchmarks.evaluator.plan import (
    FIRST_SEED,
    LEVELS_MM,
    NONE,
    STRENGTHS,
    ClonedPolicy,
    KindsPlan,
    OutsidePolicy,
    StudyPlan,
    trained_seeds,
)
from benchmarks.evaluator.work import (
    NEEDED,
    Missing,
    Study,
    open_study,
    unit_rows,
    write_single_members,
)
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.errors import InvalidInputError
from dextouch.jobs import worker_pool
from services.evaluation.bundled_policies import DEFAULT_POLICY
from services.evaluation.settings import DEFAULT_PROBE, EARLY_POLICY
from services.twin.stage import mistake_of
from services.twin.tasks import EVALUATED

_SERVO = "colour servo=services.evaluation.policies.colour_servo:ColourServo"
AMOUNTS: Final = Amounts(usual={"starts": 20}, quick={"starts": 2})
# Titles of the tables, by their names in `evaluator.json`.
_ROWS: Final[Mapping[str, tuple[str, Callable[[TaskFigures], list[dict[str, Any]]]]]] = {
    "kinds": ("Mistakes by kind, beside the ladder", TaskFigures.kind_rows),
    "policies": ("Success rates", TaskFigures.policy_rows),
    "rivals": ("AUC of single rollouts, by who judges what", TaskFigures.rival_rows),
    "chunks": ("Chunks of scripts, each figure beside its rival", TaskFigures.chunk_rows),
}
_QUICK_LEVELS_MM = (0.0, 10.0, 30.0)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    each = "once for all worlds, or once for each"
    for flag, what in {
        "--world": "the world model (committed one); may be repeated for training seeds",
        "--probe": f"the judge (committed one); {each}",
        "--direct": f"the direct judge, a baseline that imagines nothing (none); {each}",
        "--without-touch": f"a world model trained without touch, as a baseline (none); {each}",
    }.items():
        parser.add_argument(flag, action="append", type=Path, help=f"checkpoint of {what}")
    parser.add_argument(
        "--each-member",
        action="store_true",
        help="evaluate every member of a world model's ensemble alone, as a training seed",
    )
    parser.add_argument(
        "--kinds",
        default="development",
        metavar="SET|NAME,…",
        help="kinds of mistakes whose scripts are rolled out beside the ladder: development, "
        "held-out, training, none, or names. A set that was used to choose anything is no "
        "held-out set any more: ask for held-out once, at the end (%(default)s)",
    )
    parser.add_argument(
        "--strengths",
        nargs="+",
        type=float,
        default=list(STRENGTHS),
        help="strengths of mistakes, 0 … 1; every kind has one at a start, in turn (%(default)s)",
    )
    parser.add_argument(
        "--every-strength", action="store_true", help="every strength from every start instead"
    )
    parser.add_argument(
        "--ladder",
        choices=("usual", NONE),
        default="usual",
        help="scripts with position errors and all other policies; none: mistakes only (usual)",
    )
    parser.add_argument("--tasks", nargs="+", default=list(EVALUATED), help="(%(default)s)")
    AMOUNTS.add_options(parser, starts="starts per task")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED, help="%(default)s")
    parser.add_argument(
        "--cloned",
        action="append",
        metavar="NAME=PATH",
        help="cloned policy to roll out in closed loop; may be repeated (the committed two)",
    )
    parser.add_argument(
        "--policy",
        action="append",
        metavar="[NAME=]MODULE:FACTORY",
        help="policy of your own in closed loop; may be repeated (the colour servo)",
    )
    parser.add_argument(
        "--keep",
        type=Path,
        default=Path("runs/evaluator"),
        help="folder of results; existing results are not computed again (%(default)s)",
    )
    parser.add_argument(
        "--repeats",
        type=Path,
        metavar="FILE",
        help="evaluator.json of an earlier run: also report which figures differ from it",
    )
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="%(default)s")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Compute missing results, and create the tables."""
    earlier = read_lines(options.repeats) if options.repeats else {}
    plan = _plan(options)
    study, kept = open_study(plan), KeptRows(plan.keep / "rollouts.jsonl")
    units = [
        (task, seed, missing)
        for seed in plan.seeds
        for task in study.tasks
        if (missing := study.missing(kept, task, seed))
    ]
    with bar("rolling out", len(units)) as step:
        for new, name in _results(plan, units, options.jobs):
            kept.add(new)
            step(name)
    figures, failed = figures_of_tasks(study, kept)
    lines = [line for each in figures for line in each.lines()]
    rows = {name: [row for each in figures for row in of(each)] for name, (_, of) in _ROWS.items()}
    tables = [
        interval_table(lines),
        *(row_table(title, rows[name]) for name, (title, _) in _ROWS.items() if rows[name]),
    ]
    notes = [f"{task} is unknown to the world or the judge" for task in plan.tasks
             if task not in study.tasks]  # fmt: skip
    if failed:
        notes.append(f"{failed} rollouts failed and are missing; see {kept.path}")
    content = {
        "about": study.about,
        "lines": [asdict(line) for line in lines],
        **rows,
        "notes": notes,
    }
    text = json.dumps(content, indent=1, allow_nan=False)
    (plan.keep / "evaluator.json").write_text(text + "\n", encoding="utf-8")
    return StageReport(
        stage="evaluator",
        packages=("numpy", "torch", "mujoco"),
        options={
            "tasks": study.tasks,
            "starts": len(plan.seeds),
            "policies": plan.policies,
            "kinds": plan.kinds and asdict(plan.kinds),
        },
        tables=tables,
        requirements=[
            *(line.requirement() for line in lines),
            *(repetition(lines, earlier) if options.repeats else ()),
        ],
        data={name: value for name, value in content.items() if name != "notes"},
        notes=[*notes, f"rollouts and JSON: {plan.keep}"],
    )


def figures_of_tasks(study: Study, kept: KeptRows) -> tuple[list[TaskFigures], int]:
    """Figures of every task from the kept rows, and the number of failed or missing rollouts."""
    figures: list[TaskFigures] = []
    failed = 0
    for task in study.tasks:
        by_seed: list[list[Rolled]] = [[] for _ in study.members]
        for seed in study.plan.seeds:
            for policy in study.policies(task, seed):
                rolled = _rolled(study, kept, (task, seed, policy))
                failed += not rolled
                for mine, one in zip(by_seed, rolled, strict=False):
                    mine.append(one)
        if by_seed[0]:
            name = study.plan.kinds.name if study.plan.kinds else NONE
            figures.append(TaskFigures(task, by_seed, study.plan.scripts, name))
    return figures, failed


def _rolled(study: Study, kept: KeptRows, about: tuple[str, int, str]) -> list[Rolled]:
    """One rollout in the world of every training seed; nothing if it failed in one of them."""
    rows: list[dict[str, Row]] = [{} for _ in study.members]
    for (kind, number), key in study.keys(*about).items():
        row = kept.get(**key)
        if row is not None and "error" not in row:
            rows[number][kind] = row
    _, seed, policy = about
    needed = NEEDED if mistake_of(policy) is None else VERDICTS
    if any(kind not in each for each in rows for kind in needed):
        return []
    return [Rolled(policy, seed, bool(each["real"]["success"]), each) for each in rows]


def interval_table(lines: Sequence[Line]) -> ResultTable:
    """Figures with intervals and bounds, and those of every training seed if there are several."""
    several = max((len(line.by_seed) for line in lines), default=1) > 1
    rows = [
        (
            f"{line.task}: {line.what}",
            line.text(line.value),
            "" if line.interval is None else f"{line.interval[0]:.3f} to {line.interval[1]:.3f}",
            str(line.num),
            f"{line.sense} {line.bound:g} {line.unit}".rstrip(),
            line.requirement().verdict(),
            *([", ".join(map(line.text, line.by_seed))] if several else []),
        )
        for line in lines
    ]
    columns = ["", "figure", "95 % over starts", "rollouts or policies", "bound", "verdict"]
    columns += ["training seeds"] * several
    return ResultTable("Imagined and real", tuple(columns), rows)


def row_table(title: str, rows: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Rows of one kind as a table."""
    columns = tuple(dict.fromkeys(name for row in rows for name in row))
    return ResultTable(title, columns, [tuple(_cell(row.get(n)) for n in columns) for row in rows])


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else "" if value is None else str(value)


def _results(
    plan: StudyPlan, units: Sequence[tuple[str, int, Missing]], num_jobs: int
) -> Iterator[tuple[list[Row], str]]:
    """Rows of every unit, as soon as it is done."""
    if num_jobs == 1 or len(units) < 2:
        for task, seed, missing in units:
            yield unit_rows(plan, task, seed, missing), f"{task} {seed}"
        return
    with worker_pool(num_jobs) as pool:
        running = {pool.submit(unit_rows, plan, *unit): unit for unit in units}
        for done in as_completed(running):
            task, seed, _ = running[done]
            yield done.result(), f"{task} {seed}"


def _plan(options: argparse.Namespace) -> StudyPlan:
    num_starts = AMOUNTS.of(options)["starts"]
    if options.jobs < 1:
        raise InvalidInputError(f"--jobs: got {options.jobs}, expected at least 1")
    only_mistakes = options.ladder == NONE
    if only_mistakes and (options.cloned or options.policy):
        raise InvalidInputError(
            "evaluator: got --cloned or --policy with --ladder none, expected mistakes only"
        )
    worlds: Sequence[Path | None] = options.world or [None]
    if options.each_member:
        folder = options.keep / "members"
        worlds = [path for world in worlds for path in write_single_members(world, folder)]
    cloned = options.cloned or [f"cloned={DEFAULT_POLICY}", f"cloned early={EARLY_POLICY}"]
    servo = options.policy or [_SERVO]
    levels_mm = _QUICK_LEVELS_MM if options.quick else LEVELS_MM
    return StudyPlan(
        keep=options.keep,
        trained=trained_seeds(
            worlds,
            options.probe or [DEFAULT_PROBE],
            options.direct or [],
            options.without_touch or [],
        ),
        tasks=tuple(options.tasks),
        seeds=tuple(range(options.first_seed, options.first_seed + num_starts)),
        levels_mm=() if only_mistakes else levels_mm,
        kinds=KindsPlan.parse(
            options.kinds, tuple(options.strengths), every_strength=options.every_strength
        ),
        cloned=() if only_mistakes else tuple(map(ClonedPolicy.parse, cloned)),
        outside=() if only_mistakes else tuple(map(OutsidePolicy.parse, servo)),
        num_still_starts=1 if options.quick else 3,
    )
