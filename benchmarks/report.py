"""Report of a benchmark stage: machine, tables, charts, requirements; text, Markdown and JSON."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, is_dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import dextouch
from benchmarks.chart import Panel
from benchmarks.figures import Figure, Requirement
from dextouch.errors import ConflictError

NOT_INSTALLED = "not installed"


def describe_machine(packages: Sequence[str]) -> dict[str, str]:
    """Processor, memory, system, load and versions of packages, for the head of a report."""
    about = {
        "dextouch": dextouch.__version__,
        "commit": _commit(),
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB",
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "load of the last minute": f"{os.getloadavg()[0]:.2f}",
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "not set"),
    }
    return about | {name: _version(name) for name in packages}


def _commit() -> str:
    """Commit of the running code, with a mark if files are modified."""
    git, root = shutil.which("git"), Path(__file__).resolve().parents[1]
    if git is None or not (root / ".git").exists():
        return "unknown"
    command = [git, "-C", str(root), "describe", "--always", "--exclude=*", "--abbrev=12"]
    answer = subprocess.run(  # noqa: S603 (a fixed command in our own folder)
        [*command, "--dirty= with changes"], capture_output=True, text=True, check=False
    )
    return answer.stdout.strip() or "unknown"


def refuse_shape_checks() -> None:
    """Refuse to time code with run-time checks of array shapes.

    Raises ConflictError if the import hook of the tests is active in this process.
    """
    if any(type(finder).__module__.startswith("jaxtyping") for finder in sys.meta_path):
        raise ConflictError(
            "bench: this process checks array shapes at every call, which would distort timings; "
            "run `python -m benchmarks` in a separate process"
        )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return NOT_INSTALLED


def _processor() -> str:
    found = re.search(
        r"^model name\s*: (.*)", Path("/proc/cpuinfo").read_text("utf-8"), re.MULTILINE
    )
    return found[1] if found else platform.machine()


@dataclass(frozen=True)
class ResultTable:
    """Rows of text under a title; the first column names them, and the others hold numbers.

    `num_text_columns` is the number of columns from the left that hold words instead.
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    num_text_columns: int = 1


def cells(*values: Figure | float | int) -> tuple[str, ...]:
    """Texts of values: whole numbers, three digits of others, and the spread of figures."""
    return tuple(one.text() if isinstance(one, Figure) else _digits(one) for one in values)


def _digits(value: float | int) -> str:
    return str(value) if isinstance(value, int) else f"{value:.3g}"


@dataclass(frozen=True)
class StageReport:
    """Results of one run of a stage; `packages` are distributions whose versions matter to it.

    `data` holds the raw measurements for JSON: every round of every figure.
    """

    stage: str
    packages: Sequence[str]
    options: dict[str, Any]
    tables: Sequence[ResultTable]
    requirements: Sequence[Requirement]
    data: dict[str, Any]
    panels: Sequence[Panel] = ()
    notes: Sequence[str] = ()

    @cached_property
    def machine(self) -> dict[str, str]:
        """Description of the machine."""
        return describe_machine(self.packages)

    @property
    def is_met(self) -> bool:
        """Whether every requirement was measured and is met."""
        return all(requirement.is_met for requirement in self.requirements)

    def to_json(self) -> str:
        """The report as JSON text."""
        requirements = [
            {**asdict(requirement), "verdict": requirement.verdict()}
            for requirement in self.requirements
        ]
        content = {
            "stage": self.stage,
            "machine": self.machine,
            "options": self.options,
            "requirements": requirements,
            "notes": list(self.notes),
            **self.data,
        }
        return json.dumps(content, indent=2, allow_nan=False, default=_plain)


def _plain(value: object) -> object:
    """JSON of figures (every round), arrays, and the fields of dataclasses."""
    if isinstance(value, Figure):
        return value.values
    if isinstance(value, np.ndarray):
        return value.tolist()
    if is_dataclass(value):
        return vars(value)
    raise TypeError(f"report: got {type(value).__name__} in `data`, expected JSON or figures")


def show(report: StageReport, console: Console) -> None:
    """Print the machine, the tables and the requirements."""
    console.print(_table(ResultTable("Machine", ("", ""), list(report.machine.items()))))
    for table in report.tables:
        console.print(_table(table))
    for note in report.notes:
        console.print(f"Note: {note}", markup=False, highlight=False)
    console.print(_table(_acceptance(report)))


def to_markdown(report: StageReport) -> str:
    """The report as Markdown for the documentation: machine, versions, tables and notes."""
    about = ", ".join(f"{name} {value}" for name, value in report.machine.items())
    parts = [f"Machine: {about}.\n"]
    for table in (*report.tables, _acceptance(report)):
        lines = [table.columns, ("---",) * len(table.columns), *table.rows]
        parts.append(f"**{table.title}**\n")
        parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n")
    parts += [f"Note: {note}\n" for note in report.notes]
    return "\n".join(parts)


def _acceptance(report: StageReport) -> ResultTable:
    rows = [
        (
            requirement.what,
            "" if requirement.figure is None else f"{requirement.figure:.3g}",
            f"{requirement.sense} {requirement.bound:g} {requirement.unit}".strip(),
            requirement.verdict(),
        )
        for requirement in report.requirements
    ]
    return ResultTable("Acceptance", ("requirement", "measured", "bound", "verdict"), rows)


def _table(content: ResultTable) -> Table:
    table = Table(title=content.title, title_justify="left", header_style="bold")
    table.show_header = any(content.columns)
    for index, column in enumerate(content.columns):
        table.add_column(column, justify="left" if index < content.num_text_columns else "right")
    for row in content.rows:
        table.add_row(*row)
    return table
