"""Imagine the robot episodes of a store with the world model.

Their outcome is that of the same actions in the twin. The success probe is trained on them beside
true episodes, so that its probabilities hold for what is imagined, and measured on those of other
seeds to see how far imagined endings can be trusted. A state model draws only the images that the
probe looks at.
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
    """Which episodes of a store are imagined: of these tasks and seeds; None takes all.

    Of these, a process takes those whose seed leaves the remainder `part` when divided by
    `num_parts`.
    """

    tasks: tuple[str, ...] | None = None
    seeds: range | None = None
    part: int = 0
    num_parts: int = 1

    def takes(self, task: str, seed: int | None) -> bool:
        """Whether an episode of this task and seed is one of them."""
        of_task = self.tasks is None or task in self.tasks
        of_part = (seed or 0) % self.num_parts == self.part
        return of_task and of_part and (self.seeds is None or seed in self.seeds)


EVERYTHING = Choice()


def imagine_all(
    episodes: str, output: str, checkpoint: Path, choice: Choice = EVERYTHING
) -> dict[str, int]:
    """Imagine robot episodes of a store; those that are there are kept.

    Args:
        episodes: store to read.
        output: store to write.
        checkpoint: of a world model of either form.
        choice: which of the episodes.
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
    """Imagine episodes in several processes; arguments and result as of `imagine_all`."""
    if num_jobs == 1:
        return imagine_all(episodes, output, checkpoint, choice)
    parts = [replace(choice, part=part, num_parts=num_jobs) for part in range(num_jobs)]
    # A fresh interpreter: a forked one would share the threads of torch.
    with ProcessPoolExecutor(num_jobs, mp_context=get_context("spawn")) as pool:
        running = [pool.submit(imagine_all, episodes, output, checkpoint, one) for one in parts]
        return {"imagined": sum(done.result()["imagined"] for done in running)}


def judged_steps(episode: EpisodeReader) -> set[int]:
    """The steps of an episode whose images a judge of success looks at."""
    seed, last = episode.attributes.seed or 0, episode.num_steps - 1
    ends = (early_step(seed), middle_step(seed), last - 1, last)
    return {step for end in ends for step in range(end - NUM_SEEN_STEPS + 1, end + 1)}


def seed_range(text: str) -> range:
    """Seeds written as FIRST:LAST+1.

    Raises:
        ArgumentTypeError: anything else.
    """
    first, _, stop = text.partition(":")
    if not (first.isdecimal() and stop.isdecimal() and int(first) < int(stop)):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected FIRST:LAST+1 such as 0:100")
    return range(int(first), int(stop))


def positive(text: str) -> int:
    """A number of processes.

    Raises:
        ArgumentTypeError: none, or no number.
    """
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number of at least 1")
    return int(text)


def main(argv: Sequence[str]) -> int:
    """`dextouch train imagined`."""
    parser = CommandParser(
        prog="dextouch train imagined",
        description=__doc__,
        epilog="example:\n  dextouch train imagined --episodes runs/episodes --store runs/imagined",
    )
    parser.add_argument("--episodes", required=True, help="folder of the store to imagine")
    parser.add_argument("--store", required=True, help="folder of the store for the result")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        default=default_checkpoint(),
        help="of either form (the package's)",
    )
    parser.add_argument("--tasks", help="with commas (all)")
    parser.add_argument("--seeds", type=seed_range, help="FIRST:LAST+1 (all)")
    parser.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, help="processes (one a core)"
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
