"""Predict the robot episodes of a store with the world model (`dextouch train imagined`)."""

import argparse
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import torch

from dextouch.clients import RolloutClient
from dextouch.command_line import write_result
from dextouch.episodes import (
    EpisodeReader,
    EpisodeStore,
    Split,
    needs,
    scene_of,
    select_episodes,
)
from dextouch.jobs import Workers, results_of, run_jobs
from dextouch.schemas import EpisodeAttributes
from dextouch.serving import configure_logging
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.evaluation.endings import NUM_SEEN_STEPS, early_step, middle_step
from services.evaluation.progress import Progress
from services.generation import SHORT_CHUNK_STEPS, imagine_episode, whole_steps
from services.pipelines.parsers import imagined_parser
from services.pipelines.servers import served
from services.world_model.state_world import StateWorld
from services.world_model.world import open_world

WORLD = "world_model"
# Episodes of a job on a cluster, which opens the model: some ten times as long as opening it.
_IN_A_JOB: Final = 16


def chosen_episodes(
    store: EpisodeStore,
    tasks: Collection[str] | None,
    seeds: range | None,
    *,
    splits: Collection[Split] = (),
    also: Sequence[needs.Need] = (),
) -> list[EpisodeAttributes]:
    """True robot episodes of these tasks and seeds that can be imagined; None takes all.

    Raises:
        NotFoundError: there is none.
    """
    in_seeds = needs.Need(
        "of other seeds",
        "choose other --seeds",
        lambda reader: seeds is None or reader.attributes.seed in seeds,
        is_choice=True,
    )
    wanted = (in_seeds, needs.IMAGES, *also)
    readers = select_episodes(
        [store], domain="robot", tasks=tasks or (), splits=splits, needs=wanted
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
    """Imagine robot episodes of a store, and return the new ids; existing results are kept.

    Args:
        episode_ids: episodes to imagine.
        episodes: store to read.
        output: store to write.
        checkpoint: checkpoint of a world model of either kind.
        only_judged: whether a state model draws only the images that the success classifier uses.
    """
    source, target = EpisodeStore(episodes), EpisodeStore(output)
    torch.set_num_threads(1)
    configure_logging(service="imagined", log_format="auto", level="warning")
    world = open_world(checkpoint)
    app = create_world_app({WORLD: world}, WorldServiceSettings(), name="imagined")
    with served({"imagined": app}) as urls, RolloutClient(urls["imagined"]) as client:
        is_drawn_apart = only_judged and isinstance(world, StateWorld)
        made = []
        for episode_id in episode_ids:
            reader = source.open(episode_id)
            steps = judged_steps(reader) if is_drawn_apart else None
            made.append(imagine_episode(reader, client, WORLD, target, image_steps=steps))
    return made


def judged_steps(episode: EpisodeReader) -> set[int]:
    """Steps of an episode whose images the success classifier uses."""
    scene = scene_of(episode.attributes)
    last = whole_steps(episode.num_steps, SHORT_CHUNK_STEPS) - 1
    ends = (early_step(scene, last), middle_step(scene, last), last - 1, last)
    return {step for end in ends for step in range(end - NUM_SEEN_STEPS + 1, end + 1)}


def imagine(options: argparse.Namespace, wanted: Sequence[str], *, only_judged: bool) -> list[str]:
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
    num_parts = -(-len(wanted) // _IN_A_JOB) if workers.ray_address else 4 * options.jobs
    parts = [wanted[first::num_parts] for first in range(min(num_parts, len(wanted)))]
    made = list[str]()
    with Progress("imagined episodes", len(wanted)) as progress:
        jobs = run_jobs(part, parts, workers, folders=EpisodeStore(options.store).folders)
        for ids in results_of(jobs):
            made += ids
            for _ in ids:
                progress.advance()
    return made


def main(argv: Sequence[str]) -> int:
    """Run `dextouch train imagined`."""
    options = imagined_parser().parse_args(list(argv))
    splits = (options.split,) if options.split else ()
    chosen = chosen_episodes(
        EpisodeStore(options.episodes), options.tasks, options.seeds, splits=splits
    )
    wanted = [about.episode_id for about in chosen]
    count = len(imagine(options, wanted, only_judged=True))
    print(f"{count} imagined")
    write_result(options.json, {"imagined": count})
    return 0
