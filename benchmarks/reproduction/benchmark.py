"""The stage `reproduction`: the paper's tables in miniature, in the twin."""

import argparse
import json
import os
import signal
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from benchmarks.figures import Requirement
from benchmarks.report import ResultTable, StageReport, to_markdown
from benchmarks.reproduction.experiments import QUICK, TABLES, Experiments, Sizes, Table
from benchmarks.reproduction.steps import Step, run
from benchmarks.reproduction.tables import Page, data_table, make_pages
from benchmarks.stages import Bar
from dextouch.command_line import write_json_text
from dextouch.errors import NotFoundError
from dextouch.schemas import first_problems

_LEGEND = (
    "cells are means over training seeds with 95 % intervals (Student's t); in brackets the "
    "paper's numbers, measured on other data and in other units"
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage; a step that fails always gives status 1."""
    parser.set_defaults(check=True)
    add = parser.add_argument
    add("tables", nargs="*", choices=[*TABLES, []], metavar="TABLE", help=f"{', '.join(TABLES)}")
    keep = Path("runs/reproduction")
    add("--keep", type=Path, default=keep, help="folder of data and results (%(default)s)")
    add("--seeds", type=_seeds, default=(0, 1, 2), help="training seeds (0,1,2)")
    fields = ", ".join(f"{name} {one.default}" for name, one in Sizes.model_fields.items())
    sizes = f"other amounts of data and training than {fields}"
    add("--sizes", type=_sizes, metavar="JSON", help=sizes)
    jobs = "steps at a time (default: one per core)"
    add("--jobs", type=int, default=os.cpu_count() or 1, help=jobs)
    add("--list", action="store_true", help="only list the steps")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Run the missing steps, and write the tables."""
    keep: Path = options.keep
    tables: Sequence[Table] = options.tables or TABLES
    sizes = options.sizes or (QUICK if options.quick else Sizes())
    experiments = Experiments(sizes, options.seeds)
    steps = experiments.steps(tables)
    failed: list[str] = []
    pages: list[Page] = []
    notes = [_LEGEND]
    if not options.list:
        # As Ctrl-C, so that `kill` stops the commands, too.
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            failed = run(steps, keep, options.jobs)
        finally:
            signal.signal(signal.SIGTERM, before)
        for table in tables:
            try:
                pages += make_pages(keep, experiments, table)
            except NotFoundError as error:
                notes.append(f"{table}: no table; {error.message}")
    data = data_table(keep, steps)
    of_pages = [table for page in pages for table in page.tables()]
    report = StageReport(
        stage="reproduction",
        packages=("numpy", "torch", "mujoco-core"),
        options={"tables": tables, "seeds": options.seeds, "sizes": sizes.model_dump(mode="json")},
        tables=[_step_table(steps, keep)] if options.list else [*of_pages, data],
        requirements=[Requirement("steps that fail", float(len(failed)), "at most", 0.0)],
        data={
            "tables": [page.to_json() for page in pages],
            "steps": [{"step": one.name} | (one.receipt(keep) or {}) for one in steps],
            "data": [dict(zip(data.columns, row, strict=True)) for row in data.rows],
        },
        notes=[*notes, *(note for page in pages for note in page.notes())],
    )
    if not options.list:
        (keep / "tables.md").write_text(to_markdown(report), encoding="utf-8")
        write_json_text(keep / "tables.json", report.to_json())
    return report


def _step_table(steps: Sequence[Step], keep: Path) -> ResultTable:
    rows = []
    for step in steps:
        receipt = step.receipt(keep)
        state = "missing" if receipt is None else f"done, {receipt['cpu_s']:.0f} CPU s"
        rows.append((step.name, state, f"dextouch {step.command}"))
    return ResultTable("Steps", ("step", "state", "command"), rows, num_text_columns=3)


def _seeds(text: str) -> tuple[int, ...]:
    seeds = tuple(int(one) for one in text.split(","))
    if len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected different numbers, such as 0,1,2")
    return seeds


def _sizes(text: str) -> Sizes:
    try:
        return Sizes.model_validate(json.loads(text))
    except ValidationError as error:
        raise argparse.ArgumentTypeError(first_problems(error)) from error
    except json.JSONDecodeError as error:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a JSON object") from error
