"""The stress matrix as a benchmark stage: inputs that break numerical code, on every stage."""

import argparse
import importlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from benchmarks.figures import Requirement, at_most
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Bar
from benchmarks.stress.cells import (
    HAZARDS,
    Cell,
    Exemption,
    Finding,
    StageCells,
    Verdict,
    not_run,
    run_cell,
)
from dextouch.errors import UnknownNameError

# Modules of this package by the name of their stage.
STAGES: Final = {
    "geometry": "geometry",
    "clocks": "clocks",
    "hand-eye": "hand_eye",
    "retargeting": "retargeting",
    "tactile-calibration": "tactile_calibration",
    "resampling": "resampling",
    "store": "storage",
    "world-model": "world_model",
    "state-model": "state_model",
    "twin": "twin",
    "metrics": "metrics",
    "judging": "judging",
    "training": "training",
}
SIGNS: Final[dict[Verdict, str]] = {
    "held": "held",
    "failed": "**failed**",
    "does not apply": "·",
    "not run": "?",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m benchmarks stress`; a cell that fails always gives status 1."""
    parser.set_defaults(check=True)
    parser.add_argument(
        "stage", nargs="*", metavar="STAGE", help=f"stages to run (all: {', '.join(STAGES)})"
    )
    parser.add_argument(
        "--hazard", action="append", metavar="NAME", help=f"may be repeated: {', '.join(HAZARDS)}"
    )
    parser.add_argument("--list", action="store_true", help="list the cells without running them")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Run the matrix, or the given stages and hazards of it."""
    stages, hazards = options.stage or STAGES, options.hazard or HAZARDS
    for kind, names, known in (("stage", stages, STAGES), ("hazard", hazards, HAZARDS)):
        for name in names:
            if name not in known:
                raise UnknownNameError(kind, name, list(known))
    chosen = [name for name in STAGES if name in stages]
    cells = [cell for name in chosen for cell in load_cells(name).row() if cell.hazard in hazards]
    if options.list:
        return _report([_listing(cells)], [], {})
    findings = []
    with bar("stress", len(cells)) as step:
        for cell in cells:
            step(f"{cell.stage}, {cell.hazard}")
            if options.quick and isinstance(cell, Cell) and cell.slow:
                findings.append(not_run(cell))
            else:
                findings.append(run_cell(cell))
    counts = Counter(one.verdict for one in findings)
    failed = Counter(one.stage for one in findings if one.verdict == "failed")
    requirements = [
        at_most(f"{name}: cells that fail", float(failed[name]), 0.0) for name in chosen
    ]
    rows = []
    for one in findings:
        figures = {
            name: value if math.isfinite(value) else None for name, value in one.figures.items()
        }
        rows.append({**asdict(one), "figures": figures})
    data = {"counts": counts, "cells": rows}
    return _report([_matrix(findings), _results(findings)], requirements, data)


def load_cells(stage: str) -> StageCells:
    """The row of a known stage."""
    cells: StageCells = importlib.import_module(f"benchmarks.stress.{STAGES[stage]}").STAGE
    return cells


def _report(
    tables: Sequence[ResultTable], requirements: Sequence[Requirement], data: dict[str, Any]
) -> StageReport:
    packages = ("numpy", "scipy", "torch", "mujoco-core")
    return StageReport("stress", packages, {}, tables, requirements, data)


def _matrix(findings: Sequence[Finding]) -> ResultTable:
    """A row for each stage, a column for each hazard."""
    signs = {(one.stage, one.hazard): SIGNS[one.verdict] for one in findings}
    stages = dict.fromkeys(one.stage for one in findings)
    rows = [(name, *(signs.get((name, hazard), "") for hazard in HAZARDS)) for name in stages]
    return ResultTable("Matrix", ("stage", *HAZARDS), rows, num_text_columns=1 + len(HAZARDS))


def _results(findings: Sequence[Finding]) -> ResultTable:
    counts = Counter(one.verdict for one in findings)
    total_s = sum(one.time_s for one in findings)
    num_run = counts["held"] + counts["failed"]
    parts = ", ".join(f"{counts[verdict]} {verdict}" for verdict in SIGNS if counts[verdict])
    rows = [
        (
            one.stage,
            one.hazard,
            one.fed.replace("|", "/"),
            one.came_out.replace("|", "/"),
            one.verdict,
            f"{one.time_s:.2f}" if one.time_s else "",
        )
        for one in findings
    ]
    return ResultTable(
        f"{len(findings)} cells, {num_run} run in {total_s:.0f} s: {parts}",
        ("stage", "hazard", "fed", "came out", "verdict", "s"),
        rows,
        num_text_columns=5,
    )


def _listing(cells: Sequence[Cell | Exemption]) -> ResultTable:
    rows = [
        (cell.stage, cell.hazard, cell.reason, "")
        if isinstance(cell, Exemption)
        else (cell.stage, cell.hazard, cell.fed, "slow" if cell.slow else "")
        for cell in cells
    ]
    columns = ("stage", "hazard", "input, or why it does not apply", "takes")
    return ResultTable(f"{len(cells)} cells", columns, rows, num_text_columns=4)
