"""Command line `dextouch demo`: runs all stages, prints the result and writes the reports."""

import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from fastapi import FastAPI
from rich.console import Console
from rich.table import Table

from dextouch import __version__
from dextouch.command_line import write_result
from dextouch.data_folder import default_store
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.serving import configure_logging
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import CopyFirstWorld, World, WorldServiceSettings, create_world_app
from services.alignment.app import create_app as create_alignment
from services.alignment.settings import AlignmentSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from services.evaluation.command_line import print_scores
from services.evaluation.prediction import ALL_TASKS, all_metrics, described, measure_prediction
from services.evaluation.prediction_scenes import read_rollout
from services.evaluation.rendering import figure
from services.evaluation.reporting import write_report
from services.evaluation.reporting.pictures import (
    PredictionPicture,
    ReportPictures,
    action_picture,
    episode_picture,
)
from services.evaluation.reporting.sections import comparison_bars, error_rows
from services.pipelines import demo_scoring as scoring
from services.pipelines import demo_takes as recording
from services.pipelines.parsers import FIRST_HELD_OUT_SEED, TASKS, DemoPlan, demo_plan
from services.pipelines.servers import served
from services.pipelines.study import refuse_trained
from services.pipelines.twin_geometry import TwinGeometry
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld
from services.world_model.shipped_checkpoints import default_checkpoint

# Errors of both takes; the report shows the worse one.
COMMON_ERRORS = ("taxel_mae_kpa", "fingertip_error_mm", "wrist_error_mm", "wrist_error_deg")
ERRORS_BY_STREAM = ("clock_rms_ms", "latency_ms", "latency_error_ms", "num_dropped")
NUM_MOMENTS = 7


class Stages:
    """Wall time of the stages of a run, in order."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, what: str) -> Iterator[None]:
        """Context manager that times a stage and prints `what` at its start."""
        print(f"{len(self.seconds) + 1}. {what} …", file=sys.stderr, flush=True)
        begin_s = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = time.perf_counter() - begin_s
        print(f"   {self.seconds[name]:.1f} s", file=sys.stderr, flush=True)

    def rows(self) -> list[dict[str, object]]:
        """Rows for `report.json`."""
        return [{"name": name, "seconds": round(s, 3)} for name, s in self.seconds.items()]


def main(argv: Sequence[str]) -> int:
    """Run the demo; returns 0 if every stage ran, whatever the figures in the report."""
    plan = demo_plan(argv)
    configure_logging(service="demo", log_format="auto", level="warning")
    # More threads slow down small networks beside busy services.
    torch.set_num_threads(1)
    plan.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="dextouch-demo-") as folder:
        report = run(plan, Path(folder))
    for path in (plan.output / "report.json", plan.json):
        write_result(path, report, allow_nan=False)
    show(report)
    print(f"\nreport: {plan.output / 'report.html'}")
    robot = report["takes"]["robot"]["episode_id"]
    print(f"store:  {default_store()}, with both takes as recordings and as episodes; go on with")
    print("  dextouch store list")
    print(f"  dextouch export --format mcap --to {plan.output / 'robot.mcap'} {robot}")
    print("  dextouch up    # dashboard: Episodes plays both takes, Station records new ones")
    return 0


def run(plan: DemoPlan, folder: Path) -> dict[str, Any]:
    """Run all stages and return the contents of `report.json`; `folder` is for scratch."""
    stages, truths = Stages(), EpisodeStore(folder / "truth")
    with stages.stage("truth", "recording the truth in the physics twin"):
        originals, demonstrations = recording.make_truth(plan, folder / "truth")
    if plan.train:
        with stages.stage("train", "training world model, policy and probe"):
            models = scoring.train_models(plan.output / "trained")
    else:
        models = scoring.Models.load(default_checkpoint())
    starts = range(
        FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + max(plan.num_seeds, plan.num_predicted)
    )
    refuse_trained(scoring.MODEL, models.checkpoint, TASKS, starts)
    with served(_apps(folder / "alignments", models.world_model)) as urls:
        takes: dict[str, recording.Take] = {}
        for seed, original in enumerate(map(truths.open, originals)):
            taken = _take(original, folder / "spool", seed, urls, stages)
            takes[original.attributes.domain] = taken
        with stages.stage("predict", "predicting held-out scenes with the world model"):
            geometry, readers = TwinGeometry(), map(truths.open, demonstrations)
            scenes = [geometry.added_to(read_rollout(reader), reader) for reader in readers]
            metrics = tuple(all_metrics().values())
            prediction = measure_prediction(models.world_model, scenes, metrics=metrics)
        with stages.stage("judge", "scoring policies in the twin and in the world model"):
            policies = {**scoring.ladder(plan), "behaviour cloning": models.policy}
            scores, moving = scoring.score_policies(urls, policies, models, plan)
    world = models.world_model.description
    form = "state model" if world.object_names else "paper's form"
    report = {
        "about": {
            "version": __version__,
            "world model": f"{world.name}, {form}, {world.digest[:12]}",
            "held-out seeds": f"{plan.seeds[0]} … {plan.seeds[-1]}",
        },
        "success_probe": models.probe.metadata.metrics,
        "stages": stages.rows(),
        "errors": worst_errors({name: take.errors for name, take in takes.items()}),
        "errors_by_calibration": {
            name: {
                which: {error: errors[error] for error in COMMON_ERRORS}
                for which, errors in (("measured", take.errors), ("true", take.errors_true))
            }
            for name, take in takes.items()
        },
        "takes": {
            name: {
                **take.errors,
                "devices": take.devices,
                "episode_id": take.episode.attributes.episode_id,
            }
            for name, take in takes.items()
        },
        "world_model": prediction.flat(),
        "prediction": {
            "figures": prediction.by_task[ALL_TASKS],
            "metrics": described(metrics),
            "missing": dict(prediction.missing),
        },
        **scores,
    }
    with stages.stage("report", "drawing the report"):
        pictures = replace(_pictures(takes, prediction.pictures), moving=moving)
        write_report(report, pictures, plan.output / "report.html")
    return {**report, "stages": stages.rows()}


def _apps(jobs_folder: Path, world_model: World[Any]) -> dict[str, FastAPI]:
    """Services of the demo; jobs are apart from the store, which may have a running alignment."""
    store = default_store()
    alignment = AlignmentSettings(
        store_url=store, jobs_folder=jobs_folder, align_new=False, log_level="warning"
    )
    twin = TwinWorld(TwinSettings(cameras=(HEAD_CAMERA,)))
    imagined = {
        scoring.MODEL: world_model,
        scoring.BASELINE: CopyFirstWorld.beside(world_model.description),
    }
    served_worlds = WorldServiceSettings()
    return {
        "episode_store": create_store(EpisodeStoreSettings(store_url=store)),
        "alignment": create_alignment(alignment),
        "twin": create_world_app({"twin": twin}, served_worlds, name="twin"),
        "imagined": create_world_app(imagined, served_worlds, name="imagined"),
    }


def _take(
    truth: EpisodeReader, spool: Path, seed: int, urls: Mapping[str, str], stages: Stages
) -> recording.Take:
    """Record, upload and align one take, which replaces that of an earlier run."""
    domain, store = truth.attributes.domain, EpisodeStore(default_store())
    with stages.stage(f"record_{domain}", f"recording a {domain} take"):
        recorded, devices = recording.record_take(truth, spool, seed=seed)
        recording.forget_take(store, recorded.recording_id)
        recording.upload(spool, urls["episode_store"])
    with stages.stage(f"align_{domain}", f"aligning the {domain} take"):
        job = recording.align(urls["alignment"], recorded.recording_id)
        episode = store.open(job.alignment_id)
        origin_ns, errors = recording.errors_of(store, job.alignment_id, truth, recorded)
        residuals_ms = recording.clock_residuals_ms(episode, truth, origin_ns)
    with stages.stage(f"true_{domain}", "aligning it again, with the true calibration"):
        scratch = EpisodeStore(spool.parent / "true")
        exact_id = recording.align_truly(recorded, scratch, job.options).attributes.episode_id
        _, errors_true = recording.errors_of(scratch, exact_id, truth, recorded)
    return recording.Take(episode, errors, errors_true, devices, residuals_ms)


def worst_errors(takes: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The worse of the takes for every error; streams in both are prefixed by their take."""
    errors: dict[str, Any] = {
        name: {
            f"{t}.{stream}": e for t, found in takes.items() for stream, e in found[name].items()
        }
        for name in ERRORS_BY_STREAM
    }
    errors |= {name: max(found[name] for found in takes.values()) for name in COMMON_ERRORS}
    return errors | {"taxel_iou": min(found["taxel_iou"] for found in takes.values())}


def _pictures(
    takes: Mapping[str, recording.Take], predictions: tuple[PredictionPicture, ...]
) -> ReportPictures:
    return ReportPictures(
        episodes=tuple(
            replace(
                episode_picture(take.episode, num_moments=NUM_MOMENTS),
                title=f"{name.capitalize()} take, as recorded and aligned: "
                f"{take.episode.attributes.instruction}",
            )
            for name, take in takes.items()
        ),
        clock_residuals_ms=takes["human"].clock_residuals_ms,
        actions=action_picture(takes["robot"].episode),
        predictions=predictions,
    )


def show(report: Mapping[str, Any]) -> None:
    """Print stages, errors, predictions and scores."""
    console = Console()
    stages = [(row["name"], f"{row['seconds']:.1f}") for row in report["stages"]]
    console.print(_table("Stages", ("stage", "seconds"), stages))
    errors = error_rows(report["errors"])
    rows = [(row.name, f"{figure(row.value)} {row.unit}".strip(), row.bound) for row in errors]
    title = "Recording path against the twin's truth"
    console.print(_table(title, ("error", "value", "bound"), rows))
    console.print(_world_model(report["world_model"]))
    print_scores(report)
    console.print(_mistakes(report["mistakes"]))
    accuracy = report["success_probe"]["held_out_accuracy"]
    console.print(
        f"\nImagined success is classified by a probe that is correct on {accuracy:.0%} of true "
        "held-out endings; endings that the model predicts wrongly mislead it. Endings that the "
        "probe or the model flags as uncertain count with the more likely outcome. Intervals, and "
        "how many are uncertain, are in the report."
    )


def _table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]] = ()) -> Table:
    table = Table(title=title, title_justify="left", header_style="bold")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right")
    for row in rows:
        table.add_row(*row)
    return table


def _mistakes(rows: Sequence[Mapping[str, Any]]) -> Table:
    names = ("rollouts", "real", "imagined", "wrong", "cannot_tell")
    columns = ("task", "mistake", "rollouts", "real", "imagined", "wrongly imagined", "undecided")
    cells = [(row["task"], row["mistake"], *(str(row[name]) for name in names)) for row in rows]
    return _table("Successes by kind of mistake, beside the ladder of position errors",
                  columns, cells)  # fmt: skip


def _world_model(figures: Mapping[str, Any]) -> Table:
    table = _table("World model, whole rollouts of held-out scenes", ("", "", ""))
    table.show_header = False
    for group in comparison_bars(figures):
        for index, bar in enumerate(group.bars):
            name = f"{group.title}, {group.note}" if index == 0 else ""
            table.add_row(name, bar.name, f"{figure(bar.value)} {group.unit}".strip())
        table.add_section()
    return table
