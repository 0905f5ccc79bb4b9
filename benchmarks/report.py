"""Report of a benchmark stage: tables, charts and requirements, as text, Markdown and JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.chart import Panel
from benchmarks.figures import Figure, Requirement
from benchmarks.machine import describe_machine


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
        return json.dumps(content, indent=2, allow_nan=False)


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


def _table(shown: ResultTable) -> Table:
    table = Table(title=shown.title, title_justify="left", header_style="bold")
    table.show_header = any(shown.columns)
    for index, column in enumerate(shown.columns):
        table.add_column(column, justify="left" if index < shown.num_text_columns else "right")
    for row in shown.rows:
        table.add_row(*row)
    return table
