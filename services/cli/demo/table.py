"""Result tables of the demo on the terminal, of the same rows as the report page."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from services.evaluation.reporting.sections import (
    agreement_figures,
    comparison_bars,
    error_rows,
    figure,
)

AGREEMENT = ("pearson", "mmrv", "mmrv_paper")


def show(report: Mapping[str, Any]) -> None:
    """Print stages, errors, predictions and scores."""
    console = Console()
    stages = [(row["name"], f"{row['seconds']:.1f}") for row in report["stages"]]
    console.print(_table("Stages", ("stage", "seconds"), stages))
    console.print(_errors(report["errors"]))
    console.print(_world_model(report["world_model"]))
    console.print(_policies(report["policies"]))
    accuracy = report["success_probe"]["held_out_accuracy"]
    console.print(
        f"Imagined success is classified by a probe that is correct on {accuracy:.0%} of the true\n"
        "held-out endings; endings that the model predicts wrongly mislead it. Endings that the\n"
        "probe or the model flags as uncertain count with the more likely outcome.\n"
    )
    console.print(_agreement(report["agreement"]))
    for task, comments in report["comments"].items():
        console.print(f"\n{task}", style="bold")
        for comment in comments:
            console.print(f"- {comment}")


def _table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]] = ()) -> Table:
    table = Table(title=title, title_justify="left", header_style="bold")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right")
    for row in rows:
        table.add_row(*row)
    return table


def _errors(errors: Mapping[str, Any]) -> Table:
    """Errors with their bounds; of the clocks only the worst one."""
    clocks = errors["clock_rms_ms"]
    worst = max(clocks, key=lambda name: clocks[name])
    rows = error_rows({**errors, "clock_rms_ms": {f"{worst} (worst)": clocks[worst]}})
    return _table(
        "Recording path against the twin's truth",
        ("error", "value", "bound"),
        [(row.name, f"{figure(row.value)} {row.unit}".strip(), row.bound) for row in rows],
    )


def _world_model(figures: Mapping[str, Any]) -> Table:
    table = _table("World model, whole rollouts of held-out scenes", ("", "", ""))
    table.show_header = False
    for group in comparison_bars(figures):
        for index, bar in enumerate(group.bars):
            name = f"{group.title}, {group.note}" if index == 0 else ""
            table.add_row(name, bar.name, f"{figure(bar.value)} {group.unit}".strip())
        table.add_section()
    return table


def _policies(rows: list[dict[str, Any]]) -> Table:
    return _table(
        "Success of policies, with 95 % intervals",
        ("policy", "task", "real", "imagined", "of these uncertain"),
        [
            (row["policy"], row["task"], rate(row, "real"), rate(row, "imagined"),
             str(row.get("imagined_undecided", "")))
            for row in rows
        ],
    )  # fmt: skip


def rate(row: Mapping[str, Any], world: str) -> str:
    """A success rate with its 95 % interval, if the report has one."""
    interval = row.get(f"{world}_interval")
    interval_text = f" ({interval[0]:.2f} … {interval[1]:.2f})" if interval else ""
    return f"{row[world]:.2f}{interval_text}"


def _agreement(agreement: Mapping[str, Mapping[str, Any]]) -> Table:
    found = {
        task: agreement_figures({name: row[name] for name in AGREEMENT})
        for task, row in agreement.items()
    }
    names = [one.name for one in next(iter(found.values()), [])]
    title = "Agreement of real and imagined scores"
    table = _table(title, ("task", "policies", "starts N", *names))
    for task, row in agreement.items():
        size = (str(row["num_policies"]), str(row["num_starts"]))
        table.add_row(task, *size, *(figure(one.value) for one in found[task]))
    return table
