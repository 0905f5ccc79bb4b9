"""Episodes imagined from those of a store (`dextouch train imagined`, `dextouch generate`)."""

import argparse
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

import structlog
import torch

from dextouch.clients import RolloutClient
from dextouch.command_line import write_result
from dextouch.episodes import EpisodeReader, EpisodeStore, Split, needs, scene_of, select_episodes
from dextouch.errors import ConflictError, EndedError
from dextouch.jobs import Workers, results_of, run_jobs
from dextouch.schemas import EpisodeAttributes
from dextouch.serving import configure_logging
from dextouch.worlds import World, WorldServiceSettings, create_world_app
from services.evaluation.endings import NUM_SEEN_STEPS, early_step, middle_step
from services.evaluation.progress import Progress
from services.evaluation.reporting import write_report
from services.evaluation.reporting.pictures import (
    MAX_MOVING,
    PredictionPicture,
    ReportPictures,
    episode_pair,
)
from services.generation import SHORT_CHUNK_STEPS, imagine_episode, whole_steps
from services.pipelines.parsers import generate_parser, imagined_parser
from services.pipelines.servers import served
from services.world_model.checkpoints import (
    is_state_checkpoint,
    read_checkpoint,
    read_state_checkpoint,
)
from services.world_model.state_world import StateWorld
from services.world_model.training.joint_dataset import read_episode
from services.world_model.world import open_world

logger = structlog.get_logger(__name__)

WORLD = "world_model"
# Episodes of a job on a cluster, which opens the model: some ten times as long as opening it.
_IN_A_JOB: Final = 16
_NUM_MOMENTS = 8


def chosen_episodes(
    store: EpisodeStore,
    tasks: Collection[str] | None,
    seeds: range | None,
    *,
    splits: Collection[Split] = (),
    also: Sequence[needs.Need] = (),
) -> list[EpisodeAttributes]:
    """True robot episodes of these tasks and seeds that can be imagined; None takes all.

    Raises NotFoundError if there is none.
    """
    in_seeds = needs.Need(
        "of other seeds",
        "choose other --seeds",
        lambda reader: seeds is None or reader.attributes.seed in seeds,
        is_choice=True,
    )
    chosen = (in_seeds, needs.EVERY_PART, needs.FIRST_IMAGE, *also)
    readers = select_episodes(
        [store], domain="robot", tasks=tasks or (), splits=splits, needs=chosen
    )
    return [reader.attributes for reader in readers]


def imagine_all(
    episode_ids: Sequence[str],
    *,
    episodes: str,
    output: str,
    checkpoint: Path,
    only_judged: bool = True,
) -> list[str]:
    """Imagine robot episodes of a store in another, and return the new ids; results are kept.

    Those that the world cannot continue to their end are left out, with a warning. With
    `only_judged`, a state model draws only the images that the success classifier uses.
    """
    source, target = EpisodeStore(episodes), EpisodeStore(output)
    torch.set_num_threads(1)
    configure_logging(service="imagined", log_format="auto", level="warning")
    world = open_world(checkpoint)
    with served_world(world) as client:
        is_drawn_apart = only_judged and isinstance(world, StateWorld)
        made = []
        for episode_id in episode_ids:
            reader = source.open(episode_id)
            steps = judged_steps(reader) if is_drawn_apart else None
            try:
                made.append(imagine_episode(reader, client, WORLD, target, image_steps=steps))
            except EndedError as error:
                # As of one that lasts too long: it must not keep the others back.
                logger.warning("episode_not_imagined", episode_id=episode_id, reason=error.reason)
    return made


@contextmanager
def served_world(world: World[Any]) -> Iterator[RolloutClient]:
    """Context manager that serves a world by the name `WORLD`, and yields a client of it."""
    app = create_world_app({WORLD: world}, WorldServiceSettings(), name="imagined")
    with served({"imagined": app}) as urls, RolloutClient(urls["imagined"]) as client:
        yield client


def judged_steps(episode: EpisodeReader) -> set[int]:
    """Steps of an episode whose images the success classifier uses."""
    scene = scene_of(episode.attributes)
    last = whole_steps(episode.num_steps, SHORT_CHUNK_STEPS) - 1
    ends = (early_step(scene, last), middle_step(scene, last), last - 1, last)
    return {step for end in ends for step in range(end - NUM_SEEN_STEPS + 1, end + 1)}


def imagine(
    options: argparse.Namespace, episode_ids: Sequence[str], *, only_judged: bool
) -> list[str]:
    """Imagine these episodes with the options of `parsers.imagined_parser`; returns the new ids."""
    part = partial(
        imagine_all,
        episodes=options.episodes,
        output=options.store,
        checkpoint=options.checkpoint,
        only_judged=only_judged,
    )
    workers = Workers(options.jobs, options.ray)
    # Each part opens the model once.
    num_parts = -(-len(episode_ids) // _IN_A_JOB) if workers.ray_address else 4 * options.jobs
    parts = [episode_ids[first::num_parts] for first in range(min(num_parts, len(episode_ids)))]
    made = list[str]()
    with Progress("imagined episodes", len(episode_ids)) as progress:
        jobs = run_jobs(part, parts, workers, folders=EpisodeStore(options.store).folders)
        for ids in results_of(jobs):
            made += ids
            for _ in ids:
                progress.advance()
    return made


def imagined_main(argv: Sequence[str]) -> int:
    """Run `dextouch train imagined`."""
    options = imagined_parser().parse_args(list(argv))
    splits = (options.split,) if options.split else ()
    chosen = chosen_episodes(
        EpisodeStore(options.episodes), options.tasks, options.seeds, splits=splits
    )
    episode_ids = [about.episode_id for about in chosen]
    count = len(imagine(options, episode_ids, only_judged=True))
    print(f"{count} of {len(episode_ids)} imagined")
    write_result(options.json, {"imagined": count})
    return 0


def generate_main(arguments: Sequence[str]) -> int:
    """Run `dextouch generate`."""
    options = generate_parser().parse_args(list(arguments))
    source = EpisodeStore(options.episodes)
    episode_ids = chosen_sources(source, options)
    # What a killed run left unfinished.
    EpisodeStore(options.store).sweep()
    refuse_trained_episodes(source, episode_ids, options.checkpoint, command="generate")
    made = imagine(options, episode_ids, only_judged=False)
    target = EpisodeStore(options.store)
    num_bytes = sum(target.open(one).verify().num_bytes for one in made)
    print(
        f"{len(made)} of {len(episode_ids)} episodes imagined and verified, "
        f"{num_bytes / 1e6:.1f} MB in {options.store}"
    )
    if options.strips is not None:
        shown = [target.open(one) for one in sorted(made)[: options.num_strips]]
        pictures = ReportPictures(
            predictions=tuple(_picture(source, one, _NUM_MOMENTS) for one in shown),
            moving=tuple(_picture(source, one, None) for one in shown[:MAX_MOVING]),
        )
        about = {"world model": options.checkpoint.name, "episodes": len(made)}
        page = {"title": "Recorded and imagined episodes", "about": about}
        write_report(page, pictures, options.strips)
        print(f"recorded and imagined images: {options.strips}")
    write_result(options.json, {"episodes": sorted(made), "num_bytes": num_bytes})
    return 0


def chosen_sources(store: EpisodeStore, options: argparse.Namespace) -> list[str]:
    """Ids of the robot episodes to imagine, spread evenly over tasks.

    Raises NotFoundError if there is none.
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
    store: EpisodeStore, episode_ids: Sequence[str], checkpoint: Path, *, command: str
) -> None:
    """Refuse episodes that the world model was trained on; raises ConflictError if there is one."""
    if is_state_checkpoint(checkpoint):
        metadata = read_state_checkpoint(checkpoint).metadata
        trained = [
            one for one in episode_ids if metadata.may_have_seen_episode(store.open(one).attributes)
        ]
    else:
        about = read_checkpoint(checkpoint).metadata
        prints, px = set(about.train_fingerprints), about.network.image_px
        trained = [
            one
            for one in episode_ids
            # Without an image of nearly every step, nothing was trained on it.
            if needs.EVERY_IMAGE.is_met(reader := store.open(one))
            and read_episode(reader, image_px=px).fingerprint() in prints
        ]
    if trained:
        raise ConflictError(
            f"{command}: {checkpoint.name} was trained on the scenes of {len(trained)} of "
            f"{len(episode_ids)} episodes, such as {trained[0]!r}; choose another --split or "
            "--seeds",
            episodes=trained,
        )


def _picture(
    source: EpisodeStore, imagined: EpisodeReader, num_moments: int | None
) -> PredictionPicture:
    # The source, which may have been made of an episode, too.
    true_id = [one.id for one in imagined.attributes.lineage if one.kind == "episode"][-1]
    title = f"{imagined.attributes.task}: {true_id}"
    return episode_pair(title, source.open(true_id), imagined, num_moments)
