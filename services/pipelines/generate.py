"""Generate demonstrations from the actions of recorded ones (`dextouch generate`)."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dextouch.command_line import write_result
from dextouch.episodes import EpisodeReader, EpisodeStore, needs
from dextouch.errors import ConflictError
from dextouch.streams import HEAD_CAMERA
from services.evaluation.reporting import PredictionPicture, ReportPictures, write_report
from services.pipelines.imagined_data import chosen_episodes, imagine
from services.pipelines.parsers import generate_parser
from services.world_model.checkpoints import read_checkpoint
from services.world_model.state_checkpoints import is_state_checkpoint, read_state_checkpoint
from services.world_model.training.dataset import fingerprint, read_episode

_NUM_MOMENTS = 8


def main(arguments: Sequence[str]) -> int:
    """Run `dextouch generate`."""
    options = generate_parser().parse_args(list(arguments))
    source = EpisodeStore(options.episodes)
    wanted = chosen_sources(source, options)
    # What a killed run left unfinished.
    EpisodeStore(options.store).sweep()
    refuse_trained_episodes(source, wanted, options.checkpoint, command="generate")
    made = imagine(options, wanted, only_judged=False)
    target = EpisodeStore(options.store)
    num_bytes = sum(target.open(one).verify().num_bytes for one in made)
    print(
        f"{len(made)} episodes imagined and verified, {num_bytes / 1e6:.1f} MB in {options.store}"
    )
    if options.strips is not None:
        pictures = [
            _picture(source, target.open(one)) for one in sorted(made)[: options.num_strips]
        ]
        about = {"world model": options.checkpoint.name, "episodes": len(made)}
        page = {"title": "Recorded and imagined episodes", "about": about}
        write_report(page, ReportPictures(predictions=tuple(pictures)), options.strips)
        print(f"recorded and imagined images: {options.strips}")
    write_result(options.json, {"episodes": sorted(made), "num_bytes": num_bytes})
    return 0


def chosen_sources(store: EpisodeStore, options: argparse.Namespace) -> list[str]:
    """Ids of the robot episodes to imagine, spread evenly over tasks.

    Raises:
        NotFoundError: there is none.
    """
    chosen = chosen_episodes(
        store,
        options.tasks,
        options.seeds,
        splits=(options.split,) if options.split else (),
        also=() if options.with_failures else (needs.OUTCOME, needs.SUCCESS),
    )
    by_task: dict[str, list[str]] = {}
    for about in chosen:
        by_task.setdefault(about.task, []).append(about.episode_id)
    longest = max(map(len, by_task.values()))
    in_turn = [ids[k] for k in range(longest) for ids in by_task.values() if k < len(ids)]
    return in_turn[: options.count]


def refuse_trained_episodes(
    store: EpisodeStore, wanted: Sequence[str], checkpoint: Path, *, command: str
) -> None:
    """Refuse episodes that the world model was trained on.

    Raises:
        ConflictError: there is one.
    """
    if is_state_checkpoint(checkpoint):
        metadata = read_state_checkpoint(checkpoint).metadata
        trained = [
            one for one in wanted if metadata.may_have_seen_episode(store.open(one).attributes)
        ]
    else:
        about = read_checkpoint(checkpoint).metadata
        prints, px = set(about.train_fingerprints), about.network.image_px
        trained = [
            one
            for one in wanted
            if fingerprint(read_episode(store.open(one), image_px=px)) in prints
        ]
    if trained:
        raise ConflictError(
            f"{command}: {checkpoint.name} was trained on the scenes of {len(trained)} of "
            f"{len(wanted)} episodes, such as {trained[0]!r}; choose another --split or --seeds",
            episodes=trained,
        )


def _picture(source: EpisodeStore, imagined: EpisodeReader) -> PredictionPicture:
    about = imagined.attributes
    (true_id,) = {one.id for one in about.lineage if one.kind == "episode"}
    truth, steps = source.open(true_id), imagined.num_steps
    true = truth.window(0, steps, cameras=(HEAD_CAMERA,))
    predicted = imagined.window(0, steps, cameras=(HEAD_CAMERA,))
    shown = np.unique(np.linspace(0, steps - 1, _NUM_MOMENTS).round().astype(int))
    return PredictionPicture(
        f"{about.task}: {true_id}",
        shown / about.model_rate_hz,
        true.images[HEAD_CAMERA][shown],
        predicted.images[HEAD_CAMERA][shown],
        true.tactile_kpa[shown],
        predicted.tactile_kpa[shown],
    )
