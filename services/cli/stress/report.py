"""Results of the stress matrix as a table, Markdown and JSON."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Final

from rich.table import Table

from services.cli.stress.cells import HAZARDS, Finding, Verdict

COLOURS: Final[dict[Verdict, str]] = {
    "held": "green",
    "failed": "bold red",
    "does not apply": "dim",
    "not run": "yellow",
}
_SIGNS: Final[dict[Verdict, str]] = {
    "held": "held",
    "failed": "**failed**",
    "does not apply": "·",
    "not run": "?",
}


def summary(findings: Sequence[Finding]) -> str:
    """One-line summary of the matrix."""
    counts = Counter(one.verdict for one in findings)
    parts = [f"{counts[verdict]} {verdict}" for verdict in COLOURS if counts[verdict]]
    num_run = counts["held"] + counts["failed"]
    seconds = sum(one.time_s for one in findings)
    return f"{len(findings)} cells, {num_run} run in {seconds:.0f} s: {', '.join(parts)}"


def to_markdown(findings: Sequence[Finding]) -> str:
    """The matrix with one row per stage, followed by the result of every cell."""
    stages = list(dict.fromkeys(one.stage for one in findings))
    verdicts = {(one.stage, one.hazard): _SIGNS[one.verdict] for one in findings}
    lines = [f"| stage | {' | '.join(HAZARDS)} |", "|---" * (1 + len(HAZARDS)) + "|"]
    for stage in stages:
        cells = [verdicts.get((stage, hazard), "") for hazard in HAZARDS]
        lines.append(f"| {stage} | {' | '.join(cells)} |")
    lines += ["", summary(findings) + ".", "", "| stage | hazard | fed | came out | verdict |"]
    lines.append("|---" * 5 + "|")
    for one in findings:
        columns = (one.stage, one.hazard, one.fed, one.came_out, one.verdict)
        lines.append(f"| {' | '.join(text.replace('|', '/') for text in columns)} |")
    return "\n".join(lines)


def to_json(findings: Sequence[Finding]) -> str:
    """The results as JSON; non-finite figures are null."""
    counts = Counter(one.verdict for one in findings)
    rows = [asdict(one) for one in findings]
    for row in rows:
        row["figures"] = {
            what: value if abs(value) < float("inf") else None
            for what, value in row["figures"].items()
        }
    return json.dumps({"counts": counts, "cells": rows}, indent=2, allow_nan=False)


def to_table(findings: Sequence[Finding]) -> Table:
    """Table with one row per cell."""
    table = Table("stage", "hazard", "fed", "came out", "verdict", "s", header_style="bold")
    last = ""
    for one in findings:
        if one.stage != last and last:
            table.add_section()
        colour = COLOURS[one.verdict]
        table.add_row(
            one.stage if one.stage != last else "",
            one.hazard,
            one.fed,
            one.came_out,
            f"[{colour}]{one.verdict}[/]",
            f"{one.time_s:.2f}" if one.time_s else "",
        )
        last = one.stage
    return table
