"""Command line of the benchmarks: runs a stage, prints tables, writes chart and JSON."""

import argparse
import itertools
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.chart import draw
from benchmarks.report import StageReport, refuse_shape_checks, show, to_markdown
from benchmarks.stages import STAGES, load_stage
from dextouch.command_line import CommandParser, add_json, write_json_text
from dextouch.errors import UnknownNameError

EXIT_MISSED = 1
# Columns of the tables without a terminal.
WIDTH = 200
DESCRIPTION = (
    "Measure time and error of a stage of the platform, compared with other implementations. All "
    "are measured alternately in one run, so that other load affects them equally; figures are "
    "medians over the rounds with their spread."
)


def main(argv: Sequence[str]) -> int:
    """Run the benchmark of one stage; 1 with --check if a requirement is missed or unmeasured."""
    arguments = list(argv)
    if not arguments or arguments[0] in {"-h", "--help"}:
        print(usage())
        return 0
    name, *rest = arguments
    if name not in STAGES:
        raise UnknownNameError("stage", name, list(STAGES))
    stage = load_stage(name)
    parser = stage_parser(name)
    stage.add_options(parser)
    options = parser.parse_args(rest)
    refuse_shape_checks()
    with _folder(options.out) as folder:
        report: StageReport = stage.measure(options, folder, _bar)
    publish(report, options)
    return EXIT_MISSED if options.check and not report.is_met else 0


def usage() -> str:
    """The text of `python -m benchmarks --help`."""
    rows = "\n".join(f"  {name:<14}{entry.does}" for name, entry in STAGES.items())
    return f"""usage: python -m benchmarks STAGE [options]

{DESCRIPTION}

{rows}

`python -m benchmarks STAGE --help` describes a stage and its options.

example:
  python -m benchmarks store --quick"""


def stage_parser(name: str) -> argparse.ArgumentParser:
    """Parser with the options common to all stages."""
    entry = STAGES[name]
    parser = CommandParser(
        prog=f"python -m benchmarks {name}",
        description=entry.teaches,
        epilog=f"example:\n  python -m benchmarks {name} --quick --json figures.json",
    )
    add_json(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="keep tables, chart, JSON and all that was written here (default: nothing is kept)",
    )
    parser.add_argument(
        "--check", action="store_true", help="exit with status 1 if a requirement is not met"
    )
    parser.add_argument(
        "--quick", action="store_true", help="short run that only checks that everything works"
    )
    return parser


def publish(report: StageReport, options: argparse.Namespace) -> None:
    """Print the report; write JSON and chart on request."""
    console = Console()
    show(report, console if console.is_terminal else Console(width=WIDTH))
    write_json_text(options.json, report.to_json())
    if options.out is None:
        return
    kept = options.out / f"bench_{report.stage}"
    write_json_text(kept.with_suffix(".json"), report.to_json())
    kept.with_suffix(".md").write_text(to_markdown(report), encoding="utf-8")
    if report.panels:
        chart = kept.with_suffix(".svg")
        chart.write_text(draw(report.panels, title=f"bench {report.stage}"), encoding="utf-8")
        print(f"\nchart: {chart}")


@contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    """Working folder of a stage: an empty folder below --out, or a temporary one."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="dextouch-bench-") as scratch:
            yield Path(scratch)
        return
    folder = out / "written"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    yield folder


@contextmanager
def _bar(what: str, num_steps: int) -> Iterator[Callable[[str], None]]:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    console = Console(stderr=True)
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task(what, total=num_steps)
        done = itertools.count()

        def step(name: str) -> None:
            progress.update(task, completed=next(done), description=f"{what}: {name}")

        yield step
