"""Commands that judge world models and policies by episodes of a store."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from dextouch.clients import Policy
from dextouch.command_line import write_result
from dextouch.episodes import EpisodeReader, EpisodeStore, needs, select_episodes
from dextouch.errors import UnknownNameError
from dextouch.schemas import CHUNK_STEPS
from dextouch.serving import configure_logging
from services.evaluation import prediction
from services.evaluation.bundled_policies import bundled_policy, trained_policy, training_starts_of
from services.evaluation.matched_starts import WorldAddress
from services.evaluation.perceptual_networks import Metric
from services.evaluation.policies.user_policies import load_policies
from services.evaluation.prediction_names import BASELINES
from services.evaluation.prediction_scenes import Scene, read_rollout, read_windows
from services.evaluation.recorded_takes import REPLAY, read_takes, score_lines, score_recorded
from services.evaluation.success_classifier import SuccessClassifier
from services.pipelines.imagined_data import WORLD, refuse_trained_episodes, served_world
from services.pipelines.parsers import prediction_parser, recorded_parser
from services.world_model.network.model import Sampling
from services.world_model.shipped_checkpoints import default_checkpoint
from services.world_model.world import open_world

_HORIZONS: dict[str, Callable[[EpisodeReader], list[Scene]]] = {
    "windows": read_windows,
    "rollouts": lambda reader: [read_rollout(reader)],
}
EXIT_FAILED = 1


def prediction_main(arguments: Sequence[str]) -> int:
    """Run `dextouch evaluate prediction`."""
    options = prediction_parser().parse_args(list(arguments))
    metrics = prediction.all_metrics(options.weights)
    chosen = options.metrics or tuple(metrics)
    for kind, names, known in (
        ("metric", chosen, metrics),
        ("baseline", options.baselines, BASELINES),
    ):
        if unknown := sorted(set(names) - set(known)):
            raise UnknownNameError(kind, unknown[0], list(known))
    store, path = EpisodeStore(options.episodes), options.checkpoint or default_checkpoint()
    sampling = Sampling(options.sampling_steps)
    world = open_world(path, sampling=sampling, needs_touch=False)
    tasks = options.tasks or world.description.tasks
    readers = select_episodes(
        [store],
        domain="robot",
        tasks=tasks,
        needs=(needs.EVERY_PART, needs.FIRST_IMAGE, needs.longer_than(CHUNK_STEPS)),
    )
    ids = [reader.item_id for reader in readers]
    refuse_trained_episodes(store, ids, path, command="evaluate prediction")
    result: dict[str, Any] = {"checkpoint": path.name, "digest": world.description.digest}
    measured = [metrics[name] for name in chosen]
    result["metrics"] = prediction.described(measured)
    result["baselines"] = {name: BASELINES[name] for name in options.baselines}
    result["missing_baselines"] = {}
    for horizon in [options.horizon] if options.horizon else _HORIZONS:
        scenes = [scene for one in ids for scene in _HORIZONS[horizon](store.open(one))]
        if set(chosen) & set(prediction.GEOMETRY):
            # Replaying recorded takes, in this module, too, needs no twin.
            from services.pipelines.twin_geometry import TwinGeometry

            geometry = TwinGeometry()
            scenes = [geometry.added_to(one, store.open(one.episode_id)) for one in scenes]
        found = prediction.measure_prediction(
            world, scenes, metrics=measured, baselines=options.baselines
        )
        result[horizon] = dict(found.by_task)
        result[f"num_{horizon}"] = found.num_scenes
        result["missing_baselines"][horizon] = dict(found.missing)
        print(f"\n{horizon}: {found.num_scenes} from {len(ids)} episodes")
        print(_prediction_table(found, metrics))
    write_result(options.json, result, allow_nan=False)
    return 0


def _prediction_table(found: prediction.PredictionResult, metrics: Mapping[str, Metric]) -> str:
    """Figures of all tasks: a row for each metric, a column for the model and each baseline."""
    figures = found.by_task[prediction.ALL_TASKS]
    sources = list(figures)
    rows = [["", *sources]]
    for name in figures[prediction.MODEL]:
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
        f"{metrics[n].title}: {metrics[n].missing}"
        for n in figures[prediction.MODEL]
        if metrics[n].missing
    ]
    about += [f"{name}: {BASELINES[name]}" for name in sources if name != prediction.MODEL]
    about += [f"{name} is missing: {reason}" for name, reason in found.missing.items()]
    return "\n".join([*lines, "", *about])


def recorded_main(arguments: Sequence[str]) -> int:
    """Run `dextouch evaluate recorded`; returns 1 if a rollout failed."""
    options = recorded_parser().parse_args(list(arguments))
    stores = [EpisodeStore(url) for url in options.episodes]
    splits = (options.split,) if options.split else ()
    world = open_world(options.checkpoint)
    takes = read_takes(
        stores,
        tasks=options.tasks,
        splits=splits,
        most=options.count,
        further_views=world.description.optional_cameras,
        chunk_multiple=world.description.chunk_multiple,
    )
    ids = {take.episode_id for take in takes}
    for store in stores:
        own = sorted(ids & set(store.list()))
        refuse_trained_episodes(store, own, options.checkpoint, command="evaluate recorded")
    policies = _policies(options)
    probe = SuccessClassifier.load(options.probe)
    torch.set_num_threads(1)
    configure_logging(service="evaluate_recorded", log_format="auto", level="warning")
    with served_world(world) as client:
        (description,) = [one for one in client.worlds() if one.name == WORLD]
        scores = score_recorded(
            takes,
            policies,
            WorldAddress(client, WORLD),
            description,
            probe,
            trained_on={
                f"policy {name!r}": starts
                for name, policy in policies.items()
                if (starts := training_starts_of(policy))
            },
        )
    print("\n".join(score_lines(scores)))
    for failure in scores.failures:
        print(f"failed: {failure.policy}, take {failure.seed}: {failure.message}")
    about = {
        "checkpoint": options.checkpoint.name,
        "digest": description.digest,
        "probe": options.probe.name,
        "split": options.split,
    }
    write_result(options.json, {**about, **scores.to_report()}, allow_nan=False)
    return EXIT_FAILED if scores.failures else 0


def _policies(options: argparse.Namespace) -> dict[str, Policy]:
    others = [REPLAY, *(name for name, _ in options.cloned), *dict.fromkeys(options.builtin)]
    policies = load_policies(
        options.policy, options.policy_arguments, others, other_option="--cloned NAME=CHECKPOINT"
    )
    policies |= {name: trained_policy(path) for name, path in options.cloned}
    return policies | {name: bundled_policy(name) for name in options.builtin}
