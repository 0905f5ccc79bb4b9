"""Robot episodes of a store as the world model imagines them: `dextouch train imagined`.

Their outcome is that of the same actions in the twin. Measure the success probe on them to see
how far imagined endings can be trusted. It should not be trained on them: where the model
imagined another outcome, it would learn not to believe what it sees.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from rich.progress import track

from dextouch.clients.rollouts import RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch.worlds.serve import WorldServiceSettings, create_world_app
from services.cli.demo.background import served
from services.generation.demonstrations import imagine_episode
from services.world_model.checkpoints import default_checkpoint, read_checkpoint
from services.world_model.world import ModelWorld

WORLD = "world_model"


def imagine_all(episodes: str, output: str, checkpoint: Path) -> dict[str, int]:
    """Imagine every robot episode of a store; those that are there are kept.

    Args:
        episodes: store to read.
        output: store to write.
        checkpoint: of the world model.
    """
    source, target = EpisodeStore(episodes), EpisodeStore(output)
    torch.set_num_threads(1)
    world = ModelWorld(read_checkpoint(checkpoint))
    app = create_world_app({WORLD: world}, WorldServiceSettings(), name="imagined")
    made = 0
    with served({"imagined": app}) as urls, RolloutClient(urls["imagined"]) as client:
        for episode_id in track(source.list(), description="imagined episodes"):
            imagine_episode(source.open(episode_id), client, WORLD, target)
            made += 1
    return {"imagined": made}


def main(argv: Sequence[str]) -> int:
    """`dextouch train imagined`."""
    parser = argparse.ArgumentParser(prog="dextouch train imagined", description=__doc__)
    parser.add_argument("--episodes", required=True, help="folder of the store to imagine")
    parser.add_argument("--store", required=True, help="folder of the store for the result")
    parser.add_argument(
        "--checkpoint", type=Path, default=default_checkpoint(), help="world model (committed one)"
    )
    parser.add_argument("--json", type=Path, help="write the counts here")
    arguments = parser.parse_args(list(argv))
    counts = imagine_all(arguments.episodes, arguments.store, arguments.checkpoint)
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(counts, indent=2), encoding="utf-8")
    return 0
