"""Robot episodes of a store as the world model imagines them: `dextouch train imagined`.

Their outcome is that of the same actions in the twin. The success probe is trained on them beside
true episodes, so that its probabilities hold for what is imagined, and measured on those of other
seeds to see how far imagined endings can be trusted. A state model draws only the images that the
probe looks at.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.progress import track

from dextouch.clients.rollouts import RolloutClient
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.worlds.serve import WorldServiceSettings, create_world_app
from services.cli.demo.background import served
from services.evaluation.endings import NUM_SEEN_STEPS, early_step, middle_step
from services.generation.demonstrations import imagine_episode
from services.world_model.checkpoints import default_checkpoint
from services.world_model.state_world import StateWorld
from services.world_model.world import open_world

WORLD = "world_model"


@dataclass(frozen=True)
class Choice:
    """Which episodes of a store are imagined: of these tasks and seeds; None takes all."""

    tasks: tuple[str, ...] | None = None
    seeds: range | None = None

    def takes(self, task: str, seed: int | None) -> bool:
        """Whether an episode of this task and seed is one of them."""
        of_task = self.tasks is None or task in self.tasks
        return of_task and (self.seeds is None or seed in self.seeds)


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


def main(argv: Sequence[str]) -> int:
    """`dextouch train imagined`."""
    parser = argparse.ArgumentParser(prog="dextouch train imagined", description=__doc__)
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
    parser.add_argument("--json", type=Path, help="write the counts here")
    arguments = parser.parse_args(list(argv))
    tasks = tuple(arguments.tasks.split(",")) if arguments.tasks else None
    choice = Choice(tasks, arguments.seeds)
    counts = imagine_all(arguments.episodes, arguments.store, arguments.checkpoint, choice)
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(counts, indent=2), encoding="utf-8")
    return 0
