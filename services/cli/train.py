"""Command line of `dextouch train`: records training data and trains all checkpoints."""

import importlib
import sys
from collections.abc import Sequence

# Module of each command, and arguments inserted before the user's.
TRAINERS: dict[str, tuple[str, tuple[str, ...]]] = {
    "data": ("services.cli.training_data", ()),
    "world-model": ("services.world_model.__main__", ("train",)),
    "state": ("services.world_model.__main__", ("train-state",)),
    "imagined": ("services.cli.imagined_data", ()),
    "policy": ("services.evaluation.__main__", ("train-policy",)),
    "probe": ("services.evaluation.__main__", ("train-probe",)),
    "direct-judge": ("services.evaluation.__main__", ("train-direct-judge",)),
}

USAGE = """usage: dextouch train COMMAND [options]

  data         record the twin episodes that all training uses
  world-model  train the joint visuo-tactile flow-matching model
  state        train the state model: start readers and recurrent cores
  imagined     imagine these episodes with the world model
  policy       train a closed-loop policy on the demonstrations
  probe        train the success probe on true and imagined episodes
  direct-judge train its baseline, for `python -m benchmarks evaluator --direct`

Every command has --help and writes its results with --json PATH. `dextouch demo --train`
trains a small state model, a policy and a probe; docs/evaluation.md has the commands.

example:
  dextouch train data --store runs/episodes --count 20 --images 4"""


def main(argv: Sequence[str]) -> int:
    """Run one command; returns its exit status (2 for an unknown command)."""
    word, *rest = list(argv) or ["--help"]
    if word in {"-h", "--help"}:
        print(USAGE)
        raise SystemExit(0)
    if word not in TRAINERS:
        print(f"dextouch train: unknown {word!r}\n\n{USAGE}", file=sys.stderr)
        return 2
    module, before = TRAINERS[word]
    return int(importlib.import_module(module).main([*before, *rest]) or 0)
