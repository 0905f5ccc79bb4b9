"""Flags of the demo in, one frozen plan of what it does out."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dextouch.data_folder import default_store

TASKS = ("stand_bottle", "stack_bowls")
# Seeds below this are for training; the demo and every judgement use seeds from here on.
FIRST_HELD_OUT_SEED = 10_000


@dataclass(frozen=True)
class DemoPlan:
    """What one run does.

    `noise_ladder_m` are the errors of the scripted demonstrator that make policies of different
    quality; `num_seeds` held-out scenes a task are judged on.
    """

    output: Path
    json: Path | None
    train: bool
    num_seeds: int
    noise_ladder_m: tuple[float, ...] = (0.0, 0.01, 0.03)
    take_seed: int = FIRST_HELD_OUT_SEED + 900

    @property
    def seeds(self) -> range:
        """Held-out scenes that policies are judged on."""
        return range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + self.num_seeds)


def parse(argv: Sequence[str]) -> DemoPlan:
    """The plan of a command line; `--help` ends the process with the usage."""
    parser = argparse.ArgumentParser(
        prog="dextouch demo",
        description="Record a human and a robot take through mock devices, align them, compare "
        "with the twin's truth, predict with the world model, and score policies in the twin and "
        "in the world model. Ends with a table, report.json and report.html; both takes stay in "
        f"the store {default_store()}, where the next run replaces them (DEXTOUCH_DATA names "
        "another data folder).",
    )
    parser.add_argument(
        "--output", type=Path, default=Path("demo"), help="folder of the results (%(default)s)"
    )
    parser.add_argument("--json", type=Path, help="write the report here too")
    parser.add_argument(
        "--train",
        action="store_true",
        help="train world model, policy and probe anew instead of using the committed ones "
        "(takes far longer than the demo itself)",
    )
    parser.add_argument(
        "--seeds",
        type=int,
        default=6,
        help="scenes a task that policies are judged on (%(default)s)",
    )
    arguments = parser.parse_args(list(argv))
    if arguments.seeds < 1:
        parser.error(f"--seeds: got {arguments.seeds}, expected at least 1")
    return DemoPlan(arguments.output, arguments.json, arguments.train, arguments.seeds)
