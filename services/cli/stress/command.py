"""Command line `dextouch stress`: runs cells of the matrix and prints the results."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from dextouch.command_line import CommandParser, add_json, write_json_text
from dextouch.errors import UnknownNameError
from services.cli.stress.cells import HAZARDS, Cell, Exemption, Finding, not_run, run_cell
from services.cli.stress.report import summary, to_json, to_markdown, to_table
from services.cli.stress.stages import STAGES, load_stage

EXIT_FAILED = 1
WIDTH = 200
DESCRIPTION = (
    "Check every stage with inputs that break numerical code (near-singular rotations, clock "
    "steps, NaN, saturated touch, 1000 steps, …) and report the outcome: a named refusal, a "
    "bounded answer or a figure against its bound. Exits with status 1 if a cell fails."
)


def main(argv: Sequence[str]) -> int:
    """Run the matrix, or the given stages.

    Returns:
        0, or 1 if a cell fails.
    """
    options = _parser().parse_args(list(argv))
    for name in options.stage:
        if name not in STAGES:
            raise UnknownNameError("stage", name, list(STAGES))
    for name in options.hazard or ():
        if name not in HAZARDS:
            raise UnknownNameError("hazard", name, list(HAZARDS))
    cells = _chosen(options.stage or list(STAGES), options.hazard or list(HAZARDS))
    console = _console()
    if options.list:
        console.print(_listing(cells))
        return 0
    findings = _run(cells, console, quick=options.quick)
    console.print(to_table(findings))
    console.print(summary(findings), highlight=False)
    write_json_text(options.json, to_json(findings))
    if options.markdown is not None:
        options.markdown.parent.mkdir(parents=True, exist_ok=True)
        options.markdown.write_text(to_markdown(findings) + "\n", encoding="utf-8")
    return EXIT_FAILED if any(one.verdict == "failed" for one in findings) else 0


def _console() -> Console:
    """Console of the terminal's width, or wide enough for the table without a terminal."""
    console = Console()
    return console if console.is_terminal else Console(width=WIDTH)


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="dextouch stress",
        description=DESCRIPTION,
        epilog=f"Stages: {', '.join(STAGES)}.\n\nexample:\n  dextouch stress clocks --quick",
    )
    parser.add_argument("stage", nargs="*", metavar="STAGE", help="only these (default: all)")
    parser.add_argument(
        "--hazard", action="append", metavar="NAME", help=f"only these: {', '.join(HAZARDS)}"
    )
    parser.add_argument("--quick", action="store_true", help="skip slow cells")
    parser.add_argument("--list", action="store_true", help="list the cells without running them")
    add_json(parser)
    parser.add_argument(
        "--markdown", type=Path, metavar="PATH", help="write the matrix as Markdown to this file"
    )
    return parser


def _chosen(stages: Sequence[str], hazards: Sequence[str]) -> list[Cell | Exemption]:
    rows = [load_stage(name).row() for name in STAGES if name in stages]
    return [cell for row in rows for cell in row if cell.hazard in hazards]


def _run(cells: Sequence[Cell | Exemption], console: Console, *, quick: bool) -> list[Finding]:
    findings = []
    with console.status("stress") as status:
        for cell in cells:
            status.update(f"{cell.stage}, {cell.hazard}")
            if quick and isinstance(cell, Cell) and cell.slow:
                findings.append(not_run(cell))
            else:
                findings.append(run_cell(cell))
    return findings


def _listing(cells: Sequence[Cell | Exemption]) -> Table:
    table = Table("stage", "hazard", "fed, or why it does not apply", "takes", header_style="bold")
    for cell in cells:
        if isinstance(cell, Exemption):
            table.add_row(cell.stage, cell.hazard, f"[dim]{cell.reason}[/]", "")
        else:
            table.add_row(cell.stage, cell.hazard, cell.fed, "long" if cell.slow else "")
    return table
