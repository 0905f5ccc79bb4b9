"""Measure how well a world model predicts the images and touch of held-out robot episodes.

Every figure stands beside those of simple baselines: a repeated first step, the first image warped
by the camera's known motion, no touch, the model's codecs alone, and the model with other actions.
Windows of one chunk begin at true steps, as in the paper; rollouts continue from predictions.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.episodes import EpisodeReader, EpisodeStore, needs, select_episodes
from dextouch.errors import UnknownNameError
from services.cli.generate import refuse_trained_episodes
from services.cli.training_data import comma_separated
from services.cli.twin_geometry import TwinGeometry
from services.evaluation.prediction import (
    ALL_TASKS,
    BASELINES,
    DEFAULT_BASELINES,
    GEOMETRY,
    MODEL,
    Metric,
    PredictionResult,
    all_metrics,
    described,
    measure_prediction,
)
from services.evaluation.prediction_scenes import Scene, read_rollout, read_windows

_HORIZONS: dict[str, Callable[[EpisodeReader], list[Scene]]] = {
    "windows": read_windows,
    "rollouts": lambda reader: [read_rollout(reader)],
}
_EPILOG = """\
examples:
  dextouch evaluate prediction --episodes runs/heldout
  dextouch evaluate prediction --episodes runs/heldout --checkpoint runs/paper.safetensors \\
    --horizon windows --metrics psnr,contact_f1 --json runs/prediction.json
"""


def main(arguments: Sequence[str]) -> int:
    """Run `dextouch evaluate prediction`."""
    options = _parser().parse_args(list(arguments))
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


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="dextouch evaluate prediction", description=__doc__, epilog=_EPILOG)
    add = parser.add_argument
    add("--episodes", required=True, metavar="STORE", help="store of held-out episodes")
    add("--checkpoint", type=Path, metavar="PATH", help="world model (default: the package's)")
    add("--tasks", type=comma_separated, default=(), help="comma-separated (default: the model's)")
    add("--horizon", choices=list(_HORIZONS), help="only windows or only rollouts (default: both)")
    names = f"comma-separated, of {', '.join(all_metrics())} (default: all)"
    add("--metrics", type=comma_separated, default=(), help=names)
    weights = "folder of pretrained networks for the metrics that need them (docs/evaluation.md)"
    add("--weights", type=Path, metavar="PATH", help=weights)
    names = f"comma-separated, of {', '.join(BASELINES)} (default: without instructions)"
    add("--baselines", type=comma_separated, default=DEFAULT_BASELINES, help=names)
    steps = "network calls per chunk of a flow-matching model"
    add("--sampling-steps", type=int, metavar="N", help=steps)
    add_json(parser)
    return parser
