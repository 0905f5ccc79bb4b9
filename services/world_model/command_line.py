"""Commands of the world model: train both kinds of models, serve one, show its provenance."""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dextouch.command_line import ProgressLines, garbage_collection_paused, progress, write_result
from dextouch.serving import load_settings
from dextouch.worlds import World
from services.networks.weight_files import digest_of
from services.world_model import checkpoints, paper_settings
from services.world_model.network.model import Sampling
from services.world_model.plan import plan_table, training_table
from services.world_model.settings import (
    AdaptStateCommand,
    ShowCommand,
    TrainStateCommand,
    WorldModelSettings,
)
from services.world_model.world import open_world

if TYPE_CHECKING:
    from services.world_model.training.joint_trainer import TrainingProgress, TrainingReport
    from services.world_model.training.state_trainer import StateReport


def run_train(arguments: list[str]) -> int:
    """Train the form that --preset names; print the report and optionally write it to a file."""
    settings = load_settings(paper_settings.train_settings(arguments), arguments)
    if isinstance(settings, TrainStateCommand):
        return _train_state(settings)
    if settings.plan:
        settings = settings.model_copy(update={"network": settings.with_adapters().network})
        # Which includes the import of diffusers.
        with garbage_collection_paused():
            print(plan_table(settings.network))
            print(training_table(settings, settings.plan_processes))
        return 0
    return _train(settings, settings.json_path)


def run_adapt(arguments: list[str]) -> int:
    """Adapt a checkpoint to new tasks, as `run_train`."""
    settings = load_settings(paper_settings.adapt_settings(arguments), arguments)
    if isinstance(settings, AdaptStateCommand):
        return _train_state(settings)
    network = checkpoints.read_checkpoint(settings.init).metadata.network
    return _train(settings.training(network), settings.json_path)


def run_distill(arguments: list[str]) -> int:
    """Train a checkpoint to sample in few steps, as `run_train`."""
    settings = load_settings(paper_settings.DistillCommand, arguments)
    network = checkpoints.read_checkpoint(settings.init).metadata.network
    return _train(settings.training(network), settings.json_path)


def run_cache(arguments: list[str]) -> int:
    """Encode the images of a training, and print how many windows there are."""
    settings = load_settings(paper_settings.CacheCommand, arguments)
    if settings.plan:
        return run_train(arguments)
    from services.world_model.training.latent_cache import fill_latent_cache

    filled = fill_latent_cache(settings, lambda some: progress(some, "latents", len(some)))
    print(
        f"{filled.path}: {filled.num_windows} windows of {filled.num_episodes} episodes, "
        f"{filled.num_instructions} instructions"
    )
    write_result(settings.json_path, {**asdict(filled), "path": str(filled.path)})
    return 0


def _train(settings: paper_settings.TrainSettings, json_path: Path | None) -> int:
    # Plans do without these imports.
    from services.world_model.training.distribution import joined_processes
    from services.world_model.training.joint_trainer import train

    lines = ProgressLines("training", has_bar=False)

    def on_progress(now: "TrainingProgress") -> None:
        losses = f"video {now.loss_video:.3f}  touch {now.loss_tactile:.3f}"
        lines.show(f"{100 * now.share:.0f} %  step {now.step}  {losses}")

    with joined_processes(settings.device, settings.replicas) as processes:
        report = train(settings, on_progress if processes.is_first else None, processes)
    if report is not None:
        counts = f"{report.num_train_episodes} episodes, {report.num_heldout_episodes} held out"
        _show(report, f"{report.steps} steps, {counts}", json_path)
        limit = settings.step_limit
        if limit is not None and report.steps < limit:
            print(f"cut short at step {report.steps} of {limit}; --resume with a larger limit")
    return 0


def _train_state(settings: TrainStateCommand | AdaptStateCommand) -> int:
    from services.world_model.training.state_trainer import train_state

    report = train_state(settings)
    counts = f"{report.num_training_episodes} episodes, {report.num_heldout_episodes} held out"
    _show(report, counts, settings.json_path)
    return 0


def _show(report: "TrainingReport | StateReport", counts: str, json_path: Path | None) -> None:
    """Print a report and optionally write it to a file."""
    size = f"{report.num_parameters:,} parameters, {report.cpu_s:.0f} CPU s"
    print(f"{report.checkpoint} ({report.digest[:16]}): {size}, {counts}")
    for name, value in report.metrics.items():
        print(f"{name:<36} {value:.3f}")
    write_result(json_path, {**asdict(report), "checkpoint": str(report.checkpoint)})


def run_serve(arguments: list[str]) -> int:
    """Serve a checkpoint until SIGINT or SIGTERM; rollouts of others in its folder continue."""
    from dextouch.worlds import serve_worlds

    load = partial(load_settings, WorldModelSettings, arguments)
    settings = load()
    serve_worlds(
        partial(open_worlds, settings),
        settings,
        name="world_model",
        reopen=partial(open_by_digest, settings),
        load=load,
    )
    return 0


def open_worlds(settings: WorldModelSettings) -> dict[str, World[Any]]:
    """The world of the checkpoint to serve."""
    import torch

    torch.set_num_threads(settings.num_threads)
    return {settings.world_name: open_model(settings.checkpoint, settings)}


def open_by_digest(settings: WorldModelSettings, _: str, digest: str) -> World[Any] | None:
    """The world of the checkpoint with this digest beside the one that is served.

    Of the options, it gets those that it can take.
    """
    for path, found in checkpoints.list_checkpoints(settings.checkpoint.parent).items():
        if found == digest and checkpoints.is_state_checkpoint(path):
            return open_world(path)
        if found == digest:
            metadata, placement = checkpoints.read_metadata(path), settings.placement
            if metadata.network.wan is None:
                whole = {"decode_window": None, "decode_tile_px": None}
                placement = placement.model_copy(update=whole)
            guidance = settings.guidance if metadata.is_guidable else 1.0
            taken = {"placement": placement, "guidance": guidance}
            return open_model(path, settings.model_copy(update=taken))
    return None


def open_model(path: Path, settings: WorldModelSettings) -> World[Any]:
    """The world of a checkpoint, as the settings say."""
    return open_world(
        path,
        sampling=Sampling(settings.sampling_steps, settings.sampler, guidance=settings.guidance),
        objects=settings.objects,
        placement=settings.placement,
    )


def run_show(arguments: list[str]) -> int:
    """Print the metadata of one checkpoint, or of every checkpoint in a folder."""
    settings = load_settings(ShowCommand, arguments)
    path = settings.checkpoint
    if settings.plan:
        print(plan_table(checkpoints.read_metadata(path).network))
        return 0
    found = [
        _history(file) for file in (checkpoints.list_checkpoints(path) if path.is_dir() else [path])
    ]
    print(json.dumps(found, indent=2))
    write_result(settings.json_path, found)
    return 0


def _history(file: Path) -> dict[str, Any]:
    if checkpoints.is_tokenizer(file):
        stored = checkpoints.read_tokenizer(file)
        about = stored.metadata.model_dump(mode="json", exclude={"train_scenes"})
        return {"file": file.name, "digest": stored.digest, "form": "tactile tokenizer", **about}
    if checkpoints.is_state_checkpoint(file):
        state = checkpoints.read_state_checkpoint(file)
        history = {"form": "state model", **state.metadata.model_dump(mode="json")}
        return {"file": file.name, "digest": state.digest, **history}
    metadata = checkpoints.read_metadata(file)
    # The full size may not fit into memory; the others are read to check their weights, too.
    small = metadata.network.wan is None
    digest = checkpoints.read_checkpoint(file).digest if small else digest_of(file)
    history = metadata.model_dump(mode="json", exclude={"train_fingerprints"})
    return {"file": file.name, "digest": digest, "form": "paper's form", **history}
