"""Command `dextouch station calibrate show`: contents, age and sigma of a calibration."""

import argparse
from dataclasses import asdict
from datetime import datetime

from rich.console import Console
from rich.table import Table

from services.alignment.station_calibration import record


def show(options: argparse.Namespace, *, now: datetime | None = None) -> dict[str, object]:
    """Print every calibration with age and sigma, and return them as data."""
    matrices = record.load_matrices(options.folder)
    findings = record.judge(matrices, now)
    missing = record.missing_names(matrices)
    _print(findings)
    for name in missing:
        print(f"missing: {name}; takes without it are not learned from")
    levels = [finding.level for finding in findings] + ["ERROR"] * bool(missing)
    return {
        "folder": str(options.folder),
        "level": max(levels, key=list(record.LEVELS).index),
        "findings": [asdict(finding) for finding in findings],
        "missing": missing,
    }


def _print(findings: list[record.Finding]) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("", "what", "shape", "age", "known to"):
        table.add_column(heading, no_wrap=True)
    for one in findings:
        age = "unknown" if one.age_days is None else f"{one.age_days:.1f} days"
        level = f"[{record.LEVELS[one.level]}]{one.level}[/]"
        table.add_row(level, one.name, one.shape, age, one.sigma)
    Console().print(table)
    for one in findings:
        for reason in one.reasons:
            print(f"{one.level} {one.name}: {reason}")
