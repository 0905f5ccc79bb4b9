"""Command line of `dextouch train`: recording episodes and training checkpoints of every kind."""

import importlib
import sys
from collections.abc import Sequence

# What is trained: the module that does it, and the words put before the arguments.
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

  data         record the mixed twin episodes that everything is trained on
  world-model  the joint visuo-tactile flow-matching model
  state        the state model: start readers and recurrent cores on whole episodes
  imagined     those episodes as the world model imagines them
  policy       a closed-loop policy that imitates the demonstrations
  probe        the judge of imagined success, from true and imagined episodes
  direct-judge its rival, which imagines nothing: for `python -m benchmarks evaluator --direct`

Each explains itself with --help and writes its figures with --json PATH. `dextouch demo --train`
trains a small state model, a policy and a probe; docs/evaluation.md has the commands.

example:
  dextouch train data --store runs/episodes --count 20 --images 4"""


def main(argv: Sequence[str]) -> int:
    """Train one thing; 2 for a word that is none."""
    word, *rest = list(argv) or ["--help"]
    if word in {"-h", "--help"}:
        print(USAGE)
        raise SystemExit(0)
    if word not in TRAINERS:
        print(f"dextouch train: unknown {word!r}\n\n{USAGE}", file=sys.stderr)
        return 2
    module, before = TRAINERS[word]
    return int(importlib.import_module(module).main([*before, *rest]) or 0)
