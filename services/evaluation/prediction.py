"""Prediction errors of any world on held-out episodes, beside simple baselines."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from dextouch.errors import InvalidInputError
from dextouch.metrics import image as image_metrics
from dextouch.metrics import tactile as tactile_metrics
from dextouch.schemas import CHUNK_STEPS
from dextouch.tactile.layout import common_layout
from dextouch.worlds import World
from services.evaluation.perceptual_networks import Metric, Pairs, weighted_metrics
from services.evaluation.prediction_names import DEFAULT_BASELINES
from services.evaluation.prediction_scenes import (
    Future,
    Scene,
    copied,
    depth_errors,
    imagine,
    other_instruction,
    other_take,
    reconstructed,
    standing_still,
    trajectory_accuracies,
    warped,
)
from services.evaluation.progress import Progress
from services.evaluation.reporting.pictures import PredictionPicture

MODEL: Final = "model"
ALL_TASKS: Final = "all"
# Objects that stay where they are say nothing of a prediction.
_MOVED_M: Final = 0.01
_PEAK = f"{tactile_metrics.PEAK_KPA:g} kPa"
Figures = dict[str, dict[str, float | None]]


def _of_images(function: Callable[..., float], pairs: Pairs) -> float:
    """Mean over images."""
    counts = [len(future.images) for _, future in pairs]
    values = [function(predicted=future.images, true=one.truth.images) for one, future in pairs]
    return float(np.average(values, weights=counts))


def _of_touch(function: Callable[..., float], pairs: Pairs) -> float:
    """Over all measured steps, hands and taxels together; NaN if nothing was measured."""
    measured = np.concatenate([scene.truth.is_measured() for scene, _ in pairs])
    if not measured.any():
        return float("nan")
    return function(
        predicted_kpa=np.concatenate([future.tactile_kpa for _, future in pairs]),
        true_kpa=np.concatenate([scene.truth.tactile_kpa for scene, _ in pairs]),
        measured=measured,
        layout=common_layout([scene.layout for scene, _ in pairs], what="prediction: episodes"),
    )


def _of_geometry(function: Callable[..., list[float]], pairs: Pairs) -> float:
    """Mean over the scenes whose true geometry is known, and over what moves; NaN if nothing is."""
    found = [
        value
        for scene, future in pairs
        if scene.geometry is not None
        for value in function(scene.geometry, future.images)
    ]
    return float(np.mean(found)) if found else float("nan")


def _object_error(pairs: Pairs) -> float:
    """Median error in mm of objects that moved; NaN if there are none, or no prediction of them."""
    errors_m = [np.zeros(0)]
    for scene, future in pairs:
        first_m, last_m, said_m = scene.first_objects_m, scene.truth.objects_m, future.objects_m
        if first_m is None or last_m is None or said_m is None or said_m.shape != last_m.shape:
            continue
        # False where a position is not known.
        moved = np.linalg.norm(last_m - first_m, axis=1) >= _MOVED_M
        errors_m.append(np.linalg.norm(said_m - last_m, axis=1)[moved])
    found_m = np.concatenate(errors_m)
    return 1e3 * float(np.median(found_m)) if len(found_m) else float("nan")


# A new one needs its name in `prediction_names`, too, which command lines read without networks.
METRICS: Final = {metric.name: metric for metric in (
    Metric("psnr", "PSNR", "dB", "higher", "images", partial(_of_images, image_metrics.psnr),
           "peak signal-to-noise ratio of 8-bit images, mean over images, at most 100"),
    Metric("ssim", "SSIM", "", "higher", "images", partial(_of_images, image_metrics.ssim),
           "structural similarity, Gaussian window of 11 px, mean over images; 1 for equal ones"),
    Metric("trajectory_accuracy", "Trajectory Accuracy", "", "higher", "geometry",
           partial(_of_geometry, trajectory_accuracies),
           "nDTW of the hands and objects that move by 2 px or more, found by their colours, with "
           "a tolerance of 5 % of the image's width; 1 for equal trajectories"),
    Metric("geometry_error", "Geometry Error", "", "lower", "geometry",
           partial(_of_geometry, depth_errors),
           "AbsRel of the depth of what each pixel shows, found by colour, after alignment of the "
           "scale"),
    Metric("tactile_psnr", "PSNR of taxels", "dB", "higher", "touch",
           partial(_of_touch, tactile_metrics.psnr),
           f"of the error over all taxels together, with a peak of {_PEAK}"),
    Metric("tactile_ssim", "SSIM of taxels", "", "higher", "touch",
           partial(_of_touch, tactile_metrics.ssim),
           f"windows of 4 by 4 taxels in each pad, range 0 … {_PEAK}; 1 for equal pads"),
    Metric("tactile_mse", "MSE", "kPa²", "lower", "touch",
           partial(_of_touch, tactile_metrics.mse),
           "mean squared error over all taxels"),
    Metric("tactile_mae", "MAE", "kPa", "lower", "touch",
           partial(_of_touch, tactile_metrics.mae),
           "mean absolute error over all taxels"),
    Metric("contact_mae", "Contact-MAE", "kPa", "lower", "touch",
           partial(_of_touch, tactile_metrics.contact_mae),
           "mean absolute error over taxels in true contact (at least 2 kPa)"),
    Metric("contact_iou", "Contact-IoU", "", "higher", "touch",
           partial(_of_touch, tactile_metrics.contact_iou),
           "intersection over union of taxels in contact; 1 if neither side has any"),
    Metric("contact_f1", "Contact-F1", "", "higher", "touch",
           partial(_of_touch, tactile_metrics.contact_f1),
           "F1 of taxels in contact; 1 if neither side has any"),
    Metric("pad_contact_f1", "Contact-F1 of pads", "", "higher", "touch",
           partial(_of_touch, tactile_metrics.pad_contact_f1),
           "F1 of fingertips and palms in contact; 1 if neither side has any"),
    Metric("object_error", "Object error", "mm", "lower", "objects", _object_error,
           "median error at the last step of objects that moved by 1 cm or more, whose true poses "
           "are known"),
)}  # fmt: skip


def all_metrics(weights: Path | None = None) -> dict[str, Metric]:
    """Every metric of the paper's table; those with networks need a folder of their weights."""
    return METRICS | {metric.name: metric for metric in weighted_metrics(weights)}


GEOMETRY: Final = tuple(name for name, metric in METRICS.items() if metric.of == "geometry")


@dataclass(frozen=True)
class PredictionResult:
    """Figures by task (`all` for all together), source and metric; None where not available.

    The source is `model` or a baseline. `missing` says of baselines why some scenes, or all, have
    none; figures are then over the others. `pictures` are of the first scene of every task.
    """

    by_task: Mapping[str, Figures]
    num_scenes: int
    pictures: tuple[PredictionPicture, ...]
    missing: Mapping[str, str]

    def flat(self) -> dict[str, float]:
        """Available figures of all tasks as `metric` and `metric_baseline`."""
        found = {
            metric if source == MODEL else f"{metric}_{source}": value
            for source, figures in self.by_task[ALL_TASKS].items()
            for metric, value in figures.items()
            if value is not None
        }
        return {**found, "num_rollouts": float(self.num_scenes)}


def described(metrics: Iterable[Metric]) -> dict[str, dict[str, str]]:
    """Titles, units, directions and definitions of metrics, and why some have no figure."""
    return {
        one.name: {"title": one.title, "unit": one.unit, "better": one.better, "about": one.about}
        | ({"missing": one.missing} if one.missing else {})
        for one in metrics
    }


def measure_prediction(
    world: World[Any],
    scenes: Sequence[Scene],
    *,
    metrics: Sequence[Metric] = tuple(METRICS.values()),
    baselines: Sequence[str] = DEFAULT_BASELINES,
) -> PredictionResult:
    """Errors of predicted futures of scenes that the world was not trained on.

    `metrics` are some of `METRICS` or `all_metrics`, and `baselines` names of `BASELINES`. Raises
    InvalidInputError without a scene, or for one with other steps a second than the world.
    """
    if not scenes:
        raise InvalidInputError("prediction: got no scene, expected at least one")
    found: dict[str, list[tuple[Scene, Future]]] = {name: [] for name in (MODEL, *baselines)}
    reasons: dict[str, Counter[str]] = {}
    with Progress("scenes", len(scenes)) as progress:
        for scene in scenes:
            world.description.check_rate(scene.model_rate_hz, of=f"episode {scene.episode_id!r}")
            for source, pairs in found.items():
                future = _future(source, world, scene, scenes)
                if isinstance(future, str):
                    reasons.setdefault(source, Counter())[future] += 1
                else:
                    pairs.append((scene, future))
            progress.advance()
    tasks = list(dict.fromkeys(scene.start.task for scene in scenes))
    return PredictionResult(
        {
            name: {
                source: _figures(world, source, pairs, metrics, None if name == ALL_TASKS else name)
                for source, pairs in found.items()
            }
            for name in (ALL_TASKS, *tasks)
        },
        len(scenes),
        _pictures(found[MODEL]),
        {
            source: "; ".join(
                f"{reason} ({num} of {len(scenes)} scenes)" for reason, num in counted.items()
            )
            for source, counted in reasons.items()
        },
    )


def _future(source: str, world: World[Any], scene: Scene, scenes: Sequence[Scene]) -> Future | str:
    """Prediction of the world or of a baseline, or why the baseline has none."""
    truth = scene.truth
    simple: dict[str, Callable[[], Future | str]] = {
        "copy": lambda: copied(scene),
        "warp": lambda: replace(truth, images=warped(scene)),
        "zero": lambda: replace(truth, tactile_kpa=np.zeros_like(truth.tactile_kpa)),
        "codec": lambda: reconstructed(world, scene),
        "true_images": lambda: truth,
    }
    if source in simple:
        return simple[source]()
    actions = scene.actions
    if source == "other_take":
        other = other_take(scene, scenes)
        if other is None:
            return "no other take of the task is as long from this step"
        actions = other.actions[: len(actions)]
    elif source in ("hold", "hands_still"):
        actions = standing_still(scene, head_moves=source == "hands_still")
    elif source in ("no_instruction", "other_instruction"):
        sentence = "" if source == "no_instruction" else other_instruction(scene, scenes)
        if sentence is None:
            return "no other task has another instruction"
        scene = replace(scene, start=replace(scene.start, instruction=sentence))
    return imagine(world, scene, actions)


def _figures(
    world: World[Any], source: str, pairs: Pairs, metrics: Sequence[Metric], task: str | None
) -> dict[str, float | None]:
    mine = [pair for pair in pairs if task in (None, pair[0].start.task)]
    figures: dict[str, float | None] = {}
    for metric in metrics:
        # The warp is of images, zero of touch; a world may not predict touch.
        absent = source == ("warp" if metric.of == "touch" else "zero")
        if metric.of == "touch" and source not in ("copy", "zero"):
            absent = absent or not world.description.predicts_touch
        absent = absent or (source == "true_images" and metric.of != "geometry")
        # These are the truth with other images or touch.
        absent = absent or (metric.of == "objects" and source in ("warp", "zero", "codec"))
        value = float("nan")
        if metric.measure is not None and mine and not absent:
            value = metric.measure(mine)
        figures[metric.name] = value if np.isfinite(value) else None
    return figures


def _pictures(rollouts: Pairs) -> tuple[PredictionPicture, ...]:
    """The first scene of every task, at the ends of chunks."""
    firsts: dict[str, PredictionPicture] = {}
    for scene, imagined in rollouts:
        if scene.start.task in firsts:
            continue
        at = [i for i, step in enumerate(imagined.image_steps) if step % CHUNK_STEPS == 0]
        ends = np.array([imagined.image_steps[i] for i in at])
        firsts[scene.start.task] = PredictionPicture(
            title=f"{scene.start.instruction} A whole rollout, from its first image and touch.",
            times_s=ends / scene.model_rate_hz,
            true_images=scene.truth.images[at],
            predicted_images=imagined.images[at],
            true_tactile_kpa=scene.truth.tactile_kpa[ends - 1],
            predicted_tactile_kpa=imagined.tactile_kpa[ends - 1],
            layout=scene.layout,
        )
    return tuple(firsts.values())
