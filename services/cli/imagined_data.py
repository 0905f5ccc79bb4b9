"""Imagination of the robot episodes of a store by the world model.

The outcome of each is that of the same actions in the twin. The success probe is trained on them as
well as on true episodes, so that its probabilities hold for imagined endings, and is evaluated on
those of other seeds. A state model draws only the images that the probe uses.
"""

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import torch
from rich.progress import track

from dextouch.clients import RolloutClient
from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.cli.demo.background import served
from services.evaluation.endings import NUM_SEEN_STEPS, early_step, middle_step
from services.generation.demonstrations import imagine_episode
from services.world_model.checkpoints import default_checkpoint
from services.world_model.state_world import StateWorld
from services.world_model.world import open_world

WORLD = "world_model"


@dataclass(frozen=True)
class Choice:
    """Selection of episodes of a store by task and seed; None takes all.

    Each process takes the selected episodes whose seed has the remainder `part` when divided by
    `num_parts`.
    """

    tasks: tuple[str, ...] | None = None
    seeds: range | None = None
    part: int = 0
    num_parts: int = 1

    def takes(self, task: str, seed: int | None) -> bool:
        """Whether an episode of this task and seed is selected."""
        of_task = self.tasks is None or task in self.tasks
        of_part = (seed or 0) % self.num_parts == self.part
        return of_task and of_part and (self.seeds is None or seed in self.seeds)


EVERYTHING = Choice()


def imagine_all(
    episodes: str, output: str, checkpoint: Path, choice: Choice = EVERYTHING
) -> dict[str, int]:
    """Imagine robot episodes of a store; existing results are kept.

    Args:
        episodes: store to read.
        output: store to write.
        checkpoint: checkpoint of a world model of either kind.
        choice: episodes to imagine.
    """
    source, target = EpisodeStore(episodes), EpisodeStore(output)
    torch.set_num_threads(1)
    world = open_world(checkpoint)
    app = create_world_app({WORLD: world}, WorldServiceSettings(), name="imagined")
    made = 0
    with served({"imagined": app}) as urls, RolloutClient(urls["imagined"]) as client:
        for episode_id in track(source.list(), description="imagined episodes"):
            reader = source.open(episode_id)
            if choice.takes(reader.attributes.task, reader.attributes.seed):
                steps = judged_steps(reader) if isinstance(world, StateWorld) else None
                imagine_episode(reader, client, WORLD, target, image_steps=steps)
                made += 1
    return {"imagined": made}


def imagine_in_parts(
    episodes: str, output: str, checkpoint: Path, choice: Choice, num_jobs: int
) -> dict[str, int]:
    """Imagine episodes in several processes; arguments and result as in `imagine_all`."""
    if num_jobs == 1:
        return imagine_all(episodes, output, checkpoint, choice)
    parts = [replace(choice, part=part, num_parts=num_jobs) for part in range(num_jobs)]
    # Fresh interpreters: forked ones would share the threads of torch.
    with ProcessPoolExecutor(num_jobs, mp_context=get_context("spawn")) as pool:
        running = [pool.submit(imagine_all, episodes, output, checkpoint, one) for one in parts]
        return {"imagined": sum(done.result()["imagined"] for done in running)}


def judged_steps(episode: EpisodeReader) -> set[int]:
    """Steps of an episode whose images the success probe uses."""
    seed, last = episode.attributes.seed or 0, episode.num_steps - 1
    ends = (early_step(seed), middle_step(seed), last - 1, last)
    return {step for end in ends for step in range(end - NUM_SEEN_STEPS + 1, end + 1)}


def seed_range(text: str) -> range:
    """Parse seeds given as FIRST:LAST+1.

    Raises:
        ArgumentTypeError: invalid text.
    """
    first, _, stop = text.partition(":")
    if not (first.isdecimal() and stop.isdecimal() and int(first) < int(stop)):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected FIRST:LAST+1 such as 0:100")
    return range(int(first), int(stop))


def positive(text: str) -> int:
    """Parse a number of processes.

    Raises:
        ArgumentTypeError: not a positive number.
    """
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number of at least 1")
    return int(text)


def main(argv: Sequence[str]) -> int:
    """Run `dextouch train imagined`."""
    parser = CommandParser(
        prog="dextouch train imagined",
        description=__doc__,
        epilog="example:\n  dextouch train imagined --episodes runs/episodes --store runs/imagined",
    )
    parser.add_argument("--episodes", required=True, help="store of the episodes to imagine")
    parser.add_argument("--store", required=True, help="store for the imagined episodes")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        default=default_checkpoint(),
        help="world model (default: the package's)",
    )
    parser.add_argument("--tasks", help="comma-separated tasks (default: all)")
    parser.add_argument("--seeds", type=seed_range, help="FIRST:LAST+1 (default: all)")
    parser.add_argument(
        "--jobs",
        type=positive,
        default=os.cpu_count() or 1,
        help="processes (default: one per core)",
    )
    add_json(parser)
    arguments = parser.parse_args(list(argv))
    tasks = tuple(arguments.tasks.split(",")) if arguments.tasks else None
    counts = imagine_in_parts(
        arguments.episodes,
        arguments.store,
        arguments.checkpoint,
        Choice(tasks, arguments.seeds),
        arguments.jobs,
    )
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    write_result(arguments.json, counts)
    return 0
