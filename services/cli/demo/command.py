"""Command line `dextouch demo`: runs all stages and writes report.json and report.html."""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dextouch import __version__
from dextouch.command_line import write_result
from dextouch.data_folder import default_store
from dextouch.episodes import EpisodeStore
from dextouch.schemas import WorldDescription
from dextouch.serving import configure_logging
from services.cli.demo.apps import build_apps
from services.cli.demo.background import served
from services.cli.demo.judging import judge, ladder
from services.cli.demo.models import Models, committed_models, train_models, use_one_thread
from services.cli.demo.pictures import collect
from services.cli.demo.prediction import PredictionResult, measure_prediction
from services.cli.demo.recording import (
    Take,
    align,
    forget_take,
    measure,
    record_take,
    upload,
)
from services.cli.demo.settings import DemoPlan, parse
from services.cli.demo.table import show
from services.cli.demo.timing import Stages
from services.cli.demo.truth import Truth, make_truth
from services.evaluation.reporting import write_report

# Errors of both takes; the report shows the worse one.
COMMON_ERRORS = ("taxel_mae_kpa", "fingertip_error_mm", "wrist_error_mm", "wrist_error_deg")


def main(argv: Sequence[str]) -> int:
    """Run the demo.

    Returns:
        0 if every stage ran, whatever the figures in the report.
    """
    plan = parse(argv)
    configure_logging(service="demo", log_format="auto", level="warning")
    use_one_thread()
    plan.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="dextouch-demo-") as folder:
        report = Demo(plan, Path(folder)).run()
    for path in (plan.output / "report.json", plan.json):
        write_result(path, report, allow_nan=False)
    show(report)
    print(f"\nreport: {plan.output / 'report.html'}")
    robot = report["takes"]["robot"]["episode_id"]
    print(f"store:  {default_store()}, with both takes as recordings and as episodes; go on with")
    print("  dextouch store list")
    print(f"  dextouch export --format mcap --to {plan.output / 'robot.mcap'} {robot}")
    print("  dextouch up")
    return 0


class Demo:
    """One run: plan, scratch folder and stages."""

    def __init__(self, plan: DemoPlan, folder: Path) -> None:
        self.plan = plan
        self.stages = Stages()
        self._truth_folder = folder / "truth"
        self._store = default_store()
        self._spool = folder / "spool"
        # Separate from the store, which may have a running alignment service.
        self._jobs = folder / "alignments"

    def run(self) -> dict[str, Any]:
        """Run all stages and return the contents of `report.json`."""
        truth = self._make_truth()
        models = self._models()
        apps = build_apps(self._store, self._jobs, models.world_model)
        with served(apps) as urls:
            takes = self._record(truth, urls)
            prediction = self._predict(truth, models)
            scores = self._judge(urls, models)
        report = self._report(takes, prediction, scores, models)
        with self.stages.stage("report", "drawing the report"):
            write_report(
                report, collect(takes, prediction.pictures), self.plan.output / "report.html"
            )
        return {**report, "stages": self.stages.rows()}

    def _make_truth(self) -> Truth:
        stage = self.stages.stage("truth", "recording the truth in the physics twin")
        with stage, _bar("episodes") as progress:
            return make_truth(self.plan, self._truth_folder, progress)

    def _models(self) -> Models:
        if not self.plan.train:
            return committed_models()
        with self.stages.stage("train", "training world model, policy and probe"):
            return train_models(self.plan.output / "trained")

    def _record(self, truth: Truth, urls: Mapping[str, str]) -> dict[str, Take]:
        truths = EpisodeStore(self._truth_folder)
        aligned = EpisodeStore(self._store)
        takes = {}
        for seed, (domain, episode_id) in enumerate(truth.takes.items()):
            true_episode = truths.open(episode_id)
            with self.stages.stage(f"record_{domain}", f"recording a {domain} take"):
                recorded, devices = record_take(true_episode, self._spool, seed=seed)
                forget_take(aligned, recorded.recording_id)
                upload(self._spool, urls["episode_store"])
            with self.stages.stage(f"align_{domain}", f"aligning the {domain} take"):
                job = align(urls["alignment"], recorded.recording_id)
                takes[domain] = measure(
                    aligned, true_episode, recorded, job.alignment_id, devices=devices
                )
        return takes

    def _predict(self, truth: Truth, models: Models) -> PredictionResult:
        with self.stages.stage("predict", "predicting held-out scenes with the world model"):
            store = EpisodeStore(self._truth_folder)
            return measure_prediction(
                models.world_model, store, truth.demonstrations, models.trained_on
            )

    def _judge(self, urls: Mapping[str, str], models: Models) -> dict[str, Any]:
        with self.stages.stage("judge", "scoring policies in the twin and in the world model"):
            policies = {**ladder(self.plan), "behaviour cloning": models.policy}
            return judge(urls, policies, models, self.plan)

    def _report(
        self,
        takes: Mapping[str, Take],
        prediction: PredictionResult,
        scores: Mapping[str, Any],
        models: Models,
    ) -> dict[str, Any]:
        return {
            "about": {
                "version": __version__,
                "world model": describe(models.world_model.description),
                "held-out seeds": f"{self.plan.seeds[0]} … {self.plan.seeds[-1]}",
            },
            "success_probe": models.probe.metadata.metrics,
            "stages": self.stages.rows(),
            "errors": worst_errors({name: take.errors for name, take in takes.items()}),
            "takes": {
                name: {
                    **take.errors,
                    "devices": take.devices,
                    "episode_id": take.episode.attributes.episode_id,
                }
                for name, take in takes.items()
            },
            "world_model": prediction.figures,
            **scores,
        }


def describe(world: WorldDescription) -> str:
    """Short description of a world model: name, form and digest."""
    form = "state model" if world.object_names else "paper's form"
    return f"{world.name}, {form}, {world.digest[:12]}"


def worst_errors(takes: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The worse of the takes for every error; streams in both are prefixed by their take."""
    errors: dict[str, Any] = {}
    for name in ("clock_rms_ms", "latency_ms", "latency_error_ms", "num_dropped"):
        errors[name] = {
            f"{take_name}.{stream}": value
            for take_name, errors_of_take in takes.items()
            for stream, value in errors_of_take[name].items()
        }
    for name in COMMON_ERRORS:
        errors[name] = max(found[name] for found in takes.values())
    errors["taxel_iou"] = min(found["taxel_iou"] for found in takes.values())
    return errors


@contextmanager
def _bar(what: str) -> Iterator[Callable[[int, int], None]]:
    columns = (TextColumn("   {task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), transient=True) as progress:
        task = progress.add_task(what, total=None)

        def advance(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        yield advance
