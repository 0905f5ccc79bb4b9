"""Predict the robot episodes of a store with the world model (`dextouch train imagined`)."""

import argparse
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path

import torch
from rich.progress import track

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
from dextouch.schemas import EpisodeAttributes
from dextouch.serving import configure_logging
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.evaluation.endings import NUM_SEEN_STEPS, early_step, middle_step
from services.generation.demonstrations import SHORT_CHUNK_STEPS, imagine_episode, whole_steps
from services.pipelines.parsers import imagined_parser
from services.pipelines.servers import served
from services.pipelines.training_data import in_processes
from services.world_model.state_world import StateWorld
from services.world_model.world import open_world

WORLD = "world_model"


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
        for episode_id in track(episode_ids, description="imagined episodes"):
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
    parts = [wanted[first :: options.jobs] for first in range(min(options.jobs, len(wanted)))]
    return [one for made in in_processes(part, parts, options.jobs) for one in made]


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
