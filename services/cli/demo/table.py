"""Result tables of the demo on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

# Suffixes of figure names, and the predictors they denote.
PREDICTORS = (
    ("", "the model"),
    ("_hands_still", "the model, only the head moves"),
    ("_hold", "the model, nothing moves"),
    ("_other_take", "the model, another scene's actions"),
    ("_copy", "copy of the first step"),
    ("_warp", "first image, moved as the camera"),
    ("_zero", "no touch at all"),
)


def show(report: Mapping[str, Any]) -> None:
    """Print stages, errors, predictions and scores."""
    console = Console()
    console.print(_stages(report["stages"]))
    console.print(_errors(report["errors"]))
    console.print(_world_model(report["world_model"]))
    console.print(_policies(report["policies"]))
    accuracy = report["success_probe"]["held_out_accuracy"]
    console.print(
        f"Imagined success is classified by a probe that is correct on {accuracy:.0%} of the true"
    )
    console.print(
        "held-out endings; endings that the model predicts wrongly mislead it. Endings that the"
    )
    console.print("probe or the model flags as uncertain count with the more likely outcome.\n")
    console.print(_agreement(report["agreement"]))
    for task, comments in report["comments"].items():
        console.print(f"\n{task}", style="bold")
        for comment in comments:
            console.print(f"- {comment}")


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", header_style="bold")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right")
    return table


def _stages(stages: list[dict[str, Any]]) -> Table:
    table = _table("Stages", "stage", "seconds")
    for row in stages:
        table.add_row(row["name"], f"{row['seconds']:.1f}")
    return table


def _errors(errors: Mapping[str, Any]) -> Table:
    table = _table("Recording path against the twin's truth", "error", "value")
    worst = max(errors["clock_rms_ms"], key=lambda name: errors["clock_rms_ms"][name])
    table.add_row(f"clock RMS, worst stream ({worst})", f"{errors['clock_rms_ms'][worst]:.3f} ms")
    rows = (
        ("taxel_iou", "contact IoU of taxels", ""),
        ("taxel_mae_kpa", "taxel error", "kPa"),
        ("wrist_error_mm", "wrist position", "mm"),
        ("wrist_error_deg", "wrist rotation", "°"),
        ("fingertip_error_mm", "robot fingertips", "mm"),
    )
    for key, name, unit in rows:
        table.add_row(name, f"{errors[key]:.4g} {unit}".strip())
    return table


def _world_model(figures: Mapping[str, Any]) -> Table:
    table = _table(
        "World model, whole rollouts of held-out scenes", "", "images", "touch", "contact"
    )
    table.add_row("", "PSNR (dB)", "MSE (kPa²)", "F1")
    for suffix, name in PREDICTORS:
        keys = (f"{measure}{suffix}" for measure in ("psnr", "tactile_mse", "contact_f1"))
        table.add_row(name, *(f"{figures[key]:.3g}" if key in figures else "" for key in keys))
    return table


def _policies(rows: list[dict[str, Any]]) -> Table:
    table = _table(
        "Success of policies, with 95 % intervals",
        "policy",
        "task",
        "real",
        "imagined",
        "of these uncertain",
    )
    for row in rows:
        doubted = str(row.get("imagined_undecided", ""))
        table.add_row(row["policy"], row["task"], rate(row, "real"), rate(row, "imagined"), doubted)
    return table


def rate(row: Mapping[str, Any], world: str) -> str:
    """A success rate with its 95 % interval, if the report has one."""
    interval = row.get(f"{world}_interval")
    interval_text = f" ({interval[0]:.2f} … {interval[1]:.2f})" if interval else ""
    return f"{row[world]:.2f}{interval_text}"


def _agreement(agreement: Mapping[str, Mapping[str, Any]]) -> Table:
    columns = (
        "task",
        "policies",
        "starts N",
        "Pearson",
        "MMRV, ties counted",
        "MMRV, paper's rule",
    )
    table = _table("Agreement of real and imagined scores", *columns)
    for task, row in agreement.items():
        size = (str(row["num_policies"]), str(row["num_starts"]))
        table.add_row(
            task, *size, *(_maybe(row[name]) for name in ("pearson", "mmrv", "mmrv_paper"))
        )
    return table


def _maybe(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.3f}"
