"""The command `dextouch reproduce`: the paper's tables in miniature, in the twin."""

import argparse
import json
import os
import signal
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dextouch import __version__
from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.errors import NotFoundError
from dextouch.schemas import first_problems
from services.cli.reproduce.experiments import TABLES, Experiments, Table
from services.cli.reproduce.pages import Page
from services.cli.reproduce.provenance import data_markdown, data_of
from services.cli.reproduce.sizes import QUICK, Sizes
from services.cli.reproduce.steps import Runner, Step
from services.cli.reproduce.tables import make_pages

REPORT, REPORT_JSON = "tables.md", "tables.json"
_DESCRIPTION = """\
Reproduce the tables of the paper in miniature: record data in the twin, train world models, adapt
them, evaluate and train policies, and write the tables beside the paper's numbers. Every step is a
dextouch command. A stopped run is continued by the same command; steps that are done are not run
again unless their commands changed.
"""
_EPILOG = """\
examples:
  dextouch reproduce --list
  dextouch reproduce design scaling
  dextouch reproduce --quick --folder runs/quick
  dextouch reproduce --sizes '{"train_cpu_s": 900}'
"""


def main(arguments: Sequence[str]) -> int:
    """Run `dextouch reproduce`; returns 1 if a step failed."""
    options = _parser().parse_args(list(arguments))
    tables = options.tables or TABLES
    experiments = Experiments(options.sizes or (QUICK if options.quick else Sizes()), options.seeds)
    steps = experiments.steps(tables)
    runner = Runner(options.folder, steps)
    if options.list:
        _list(runner, steps)
        return 0
    # As Ctrl-C, so that `kill` stops the commands, too.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        failed = runner.run(options.jobs)
    finally:
        signal.signal(signal.SIGTERM, before)
    pages: list[Page] = []
    for table in tables:
        try:
            pages += make_pages(options.folder, experiments, table)
        except NotFoundError as error:
            print(f"{table}: no table; {error.message}")
    figures = {"version": __version__, "tables": [page.to_json() for page in pages]}
    figures["steps"] = _steps_done(runner, steps)
    data = data_of(options.folder, steps)
    figures["data"] = [asdict(row) for row in data]
    text = _head(tables, experiments) + "\n".join(page.markdown() for page in pages)
    text += "\n" + data_markdown(data)
    (options.folder / REPORT).write_text(text, encoding="utf-8")
    write_result(options.folder / REPORT_JSON, figures)
    write_result(options.json, figures)
    print(f"tables: {options.folder / REPORT}")
    return 1 if failed else 0


def _list(runner: Runner, steps: Sequence[Step]) -> None:
    for step in steps:
        receipt = runner.receipt(step.name)
        state = "missing" if receipt is None else f"done, {receipt.cpu_s:.0f} CPU s"
        print(f"{step.name}  [{state}]\n    {step.command}")


def _steps_done(runner: Runner, steps: Sequence[Step]) -> list[dict[str, Any]]:
    """Command, digest and time of every step that is done."""
    receipts = {step.name: runner.receipt(step.name) for step in steps}
    return [{"step": name, **one.model_dump()} for name, one in receipts.items() if one]


def _head(tables: Sequence[Table], experiments: Experiments) -> str:
    seeds = ",".join(map(str, experiments.seeds))
    changed = experiments.sizes.model_dump(mode="json", exclude_defaults=True)
    sizes = f" --sizes '{json.dumps(changed)}'" if changed else ""
    return (
        f"# Tables\n\n`dextouch reproduce {' '.join(tables)} --seeds {seeds}{sizes}`, DexTouch "
        f"{__version__}. Cells are means over training seeds with 95 % intervals (Student's t); in "
        "brackets the paper's numbers, measured on other data and in other units.\n\n"
    )


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


def _parser() -> argparse.ArgumentParser:
    fields = "\n".join(
        f"  {name:<20}{field.description} ({field.default})"
        for name, field in Sizes.model_fields.items()
    )
    parser = CommandParser(
        prog="dextouch reproduce",
        description=_DESCRIPTION,
        epilog=f"{_EPILOG}\nsizes:\n{fields}",
    )
    add = parser.add_argument
    add("tables", nargs="*", choices=[*TABLES, []], metavar="TABLE", help=f"{', '.join(TABLES)}")
    default = Path("runs/reproduction")
    add("--folder", type=Path, default=default, help="folder of data and results (%(default)s)")
    add("--seeds", type=_seeds, default=(0, 1, 2), help="training seeds (0,1,2)")
    sizes = parser.add_mutually_exclusive_group()
    sizes.add_argument("--quick", action="store_true", help="very small sizes, to try the steps")
    sizes.add_argument("--sizes", type=_sizes, metavar="JSON", help="other sizes (below)")
    jobs = "steps at a time (default: one per core)"
    add("--jobs", type=int, default=os.cpu_count() or 1, help=jobs)
    add("--list", action="store_true", help="only list the steps")
    add_json(parser)
    return parser
