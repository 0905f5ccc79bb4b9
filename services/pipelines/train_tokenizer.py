"""Command that trains a tactile tokenizer and draws its learning curve beside those of others."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from dextouch.command_line import ProgressLines, write_result
from dextouch.serving import load_settings
from services.evaluation.reporting.pictures import Line, line_chart, stand_alone
from services.world_model.checkpoints import Reconstruction, TokenizerMetadata, read_tokenizer
from services.world_model.paper_settings import TrainTokenizerCommand
from services.world_model.training.tokenizer_trainer import TokenizerReport, train_tokenizer


def main(arguments: list[str]) -> int:
    """Run `dextouch train tokenizer`."""
    settings = load_settings(TrainTokenizerCommand, arguments)
    # Read first, so that a wrong path fails at once.
    beside = [read_tokenizer(path).metadata for path in settings.beside]
    columns = (
        TextColumn("training"),
        BarColumn(),
        TextColumn("step {task.fields[step]}  Contact-IoU {task.fields[iou]:.3f}"),
        TimeRemainingColumn(),
    )
    lines = ProgressLines("training")
    with Progress(*columns) as bar:
        task = bar.add_task("training", total=1.0, step=0, iou=float("nan"))

        def on_evaluation(share: float, now: Reconstruction) -> None:
            bar.update(task, completed=share, step=now.step, iou=now.contact_iou)
            lines.show(f"{100 * share:.0f} %  step {now.step}  Contact-IoU {now.contact_iou:.3f}")

        report = train_tokenizer(settings, on_evaluation)
    print(_table(report))
    if settings.picture is not None:
        draw_curves([*beside, report.metadata], settings.picture)
    result = {
        "checkpoint": str(report.checkpoint),
        "digest": report.digest,
        "ms_per_1000_hands": report.ms_per_1000_hands,
        **report.metadata.model_dump(mode="json", exclude={"train_scenes"}),
    }
    write_result(settings.json_path, result)
    return 0


def draw_curves(runs: Sequence[TokenizerMetadata], path: Path) -> None:
    """Draw held-out reconstruction error and Contact-IoU over training steps as an SVG file.

    Runs of one tokenizer have one colour. A tokenizer without training steps is a dashed line.
    """
    names = list(dict.fromkeys(run.tokenizer for run in runs))
    longest = max(point.step for run in runs for point in run.curve)
    charts = []
    for figure, label in (
        ("mse_kpa2", "reconstruction error (log10 of kPa²)"),
        ("contact_iou", "Contact-IoU"),
    ):
        lines = []
        for run in runs:
            points = [(point.step, getattr(point, figure)) for point in run.curve]
            if run.training_steps == 0:
                points = [(0, points[-1][1]), (longest, points[-1][1])]
            x, y = np.array(points, dtype=np.float64).T
            if figure == "mse_kpa2":
                y = np.log10(np.maximum(y, 1e-9))
            title = f"{run.tokenizer}, seed {run.seed}"
            dashed = run.training_steps == 0
            lines.append(Line(title, x, y, style=names.index(run.tokenizer), dashed=dashed))
        charts.append(line_chart(lines, x_label="training steps", y_label=label))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        stand_alone(charts, {name: k for k, name in enumerate(names)}), encoding="utf-8"
    )


def _table(report: TokenizerReport) -> str:
    about, last = report.metadata, report.metadata.curve[-1]
    rows = [
        ("checkpoint", str(report.checkpoint)),
        ("digest", report.digest[:16]),
        ("parameters", f"{about.num_parameters:,}"),
        ("steps", f"{about.training_steps} in {about.training_cpu_s:.0f} CPU s"),
        ("hands", f"{about.num_training_hands}, held out {about.num_heldout_hands}"),
        ("error", f"{last.mse_kpa2:.4g} kPa² (MSE), {last.mae_kpa:.4g} kPa (MAE)"),
        ("contact", f"IoU {last.contact_iou:.4f}, F1 {last.contact_f1:.4f}"),
        ("time", f"{report.ms_per_1000_hands:.1f} CPU ms per 1000 hands"),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)
