"""Measure predicted images and touch on held-out episodes (`dextouch evaluate prediction`)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dextouch.command_line import write_result
from dextouch.episodes import EpisodeReader, EpisodeStore, needs, select_episodes
from dextouch.errors import UnknownNameError
from services.evaluation.perceptual_networks import Metric
from services.evaluation.prediction import (
    ALL_TASKS,
    GEOMETRY,
    MODEL,
    PredictionResult,
    all_metrics,
    described,
    measure_prediction,
)
from services.evaluation.prediction_names import BASELINES
from services.evaluation.prediction_scenes import Scene, read_rollout, read_windows
from services.pipelines.generate import refuse_trained_episodes
from services.pipelines.parsers import prediction_parser
from services.pipelines.twin_geometry import TwinGeometry

_HORIZONS: dict[str, Callable[[EpisodeReader], list[Scene]]] = {
    "windows": read_windows,
    "rollouts": lambda reader: [read_rollout(reader)],
}


def main(arguments: Sequence[str]) -> int:
    """Run `dextouch evaluate prediction`."""
    options = prediction_parser().parse_args(list(arguments))
    from services.world_model.shipped_checkpoints import default_checkpoint
    from services.world_model.world import open_world

    metrics = all_metrics(options.weights)
    chosen = options.metrics or tuple(metrics)
    for kind, names, known in (
        ("metric", chosen, metrics),
        ("baseline", options.baselines, BASELINES),
    ):
        if unknown := sorted(set(names) - set(known)):
            raise UnknownNameError(kind, unknown[0], list(known))
    store, path = EpisodeStore(options.episodes), options.checkpoint or default_checkpoint()
    world = open_world(path, sampling_steps=options.sampling_steps, needs_touch=False)
    tasks = options.tasks or world.description.tasks
    readers = select_episodes([store], domain="robot", tasks=tasks, needs=(needs.IMAGES,))
    wanted = [reader.item_id for reader in readers]
    refuse_trained_episodes(store, wanted, path, command="evaluate prediction")
    result: dict[str, Any] = {"checkpoint": path.name, "digest": world.description.digest}
    measured = [metrics[name] for name in chosen]
    result["metrics"] = described(measured)
    result["baselines"] = {name: BASELINES[name] for name in options.baselines}
    result["missing_baselines"] = {}
    for horizon in [options.horizon] if options.horizon else _HORIZONS:
        scenes = [scene for one in wanted for scene in _HORIZONS[horizon](store.open(one))]
        if set(chosen) & set(GEOMETRY):
            geometry = TwinGeometry()
            scenes = [geometry.added_to(one, store.open(one.episode_id)) for one in scenes]
        found = measure_prediction(world, scenes, metrics=measured, baselines=options.baselines)
        result[horizon] = dict(found.by_task)
        result[f"num_{horizon}"] = found.num_scenes
        result["missing_baselines"][horizon] = dict(found.missing)
        print(
            f"\n{horizon}: {found.num_scenes} from {len(wanted)} episodes\n{_table(found, metrics)}"
        )
    write_result(options.json, result, allow_nan=False)
    return 0


def _table(found: PredictionResult, metrics: Mapping[str, Metric]) -> str:
    """Figures of all tasks: a row for each metric, a column for the model and each baseline."""
    figures = found.by_task[ALL_TASKS]
    sources = list(figures)
    rows = [["", *sources]]
    for name in figures[MODEL]:
        metric = metrics[name]
        if metric.missing:
            continue
        arrow = {"higher": "↑", "lower": "↓"}[metric.better]
        unit = f" ({metric.unit})" if metric.unit else ""
        values = [figures[source][name] for source in sources]
        cells = ["-" if value is None else f"{value:.3f}" for value in values]
        rows.append([f"{metric.title}{unit} {arrow}", *cells])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows
    ]
    about = [
        f"{metrics[n].title}: {metrics[n].missing}" for n in figures[MODEL] if metrics[n].missing
    ]
    about += [f"{name}: {BASELINES[name]}" for name in sources if name != MODEL]
    about += [f"{name} is missing: {reason}" for name, reason in found.missing.items()]
    return "\n".join([*lines, "", *about])
