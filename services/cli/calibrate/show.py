"""Command `dextouch station calibrate show`: contents, age and sigma of a calibration."""

import argparse
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.table import Table

from dextouch.episodes.spool import read_attributes
from dextouch.schemas import Matrix
from services.cli.calibrate.record import Finding, judge, read_matrices

# Alignment refuses takes without these, or without those of the recorded gloves.
NEEDED = ("K_head",)
_STYLES = {"OK": "green", "WARN": "yellow", "ERROR": "bold red"}


def show(options: argparse.Namespace, *, now: datetime | None = None) -> dict[str, object]:
    """Print every calibration with age and sigma, and return them as data."""
    matrices = load(options.folder)
    findings = judge(matrices, now=now or datetime.now(UTC))
    missing = missing_names(matrices)
    _print(findings)
    for name in missing:
        print(f"missing: {name}; alignment refuses takes that need it")
    levels = [finding.level for finding in findings] + ["ERROR"] * bool(missing)
    worst = max(levels, key=list(_STYLES).index)
    return {
        "folder": str(options.folder),
        "level": worst,
        "findings": [asdict(finding) for finding in findings],
        "missing": missing,
    }


def load(path: Path) -> dict[str, Matrix]:
    """Matrices of a calibration folder or file, or of a spooled take."""
    if (path / "recording.json").is_file():
        return dict(read_attributes(path).calibration)
    return read_matrices(path)


def missing_names(matrices: dict[str, Matrix]) -> list[str]:
    """Missing required matrices; a glove needs both tare and gain."""
    missing = [name for name in NEEDED if name not in matrices]
    for side in ("left", "right"):
        pair = (f"tactile_{side}_tare_counts", f"tactile_{side}_gain_counts_per_kpa")
        there = [name for name in pair if name in matrices]
        if len(there) == 1:
            missing += [name for name in pair if name not in matrices]
    return missing


def _print(findings: list[Finding]) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("", "what", "shape", "age", "known to"):
        table.add_column(heading, no_wrap=True)
    for finding in findings:
        age = "unknown" if finding.age_days is None else f"{finding.age_days:.1f} days"
        table.add_row(
            f"[{_STYLES[finding.level]}]{finding.level}[/]",
            finding.name,
            finding.shape,
            age,
            finding.sigma,
        )
    Console().print(table)
    for finding in findings:
        for reason in finding.reasons:
            print(f"{finding.level} {finding.name}: {reason}")
