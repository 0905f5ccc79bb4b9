"""Command line options of the demo, and the plan derived from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dextouch.command_line import CommandParser, add_json
from dextouch.data_folder import default_store

TASKS = ("stand_bottle", "stack_bowls")
# No training or tuning uses seeds from 30000 on; the evaluator benchmark takes the first ones.
FIRST_HELD_OUT_SEED = 31_000


@dataclass(frozen=True)
class DemoPlan:
    """Plan of one run.

    `levels_mm` are the errors of the scripted demonstrator, which give policies of different
    quality; `mistakes` are scripts with mistakes of kinds that no training data contain;
    `num_seeds` is the number of held-out scenes per task. The world model is measured on
    `num_predicted` scenes per task, with each of the errors `predicted_noise_m`.
    """

    output: Path
    json: Path | None
    train: bool
    num_seeds: int
    levels_mm: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0)
    mistakes: tuple[str, ...] = ("frame_yaw 0.4", "low_rate 0.5", "side_approach 0.4")
    predicted_noise_m: tuple[float, ...] = (0.0, 0.02)
    num_predicted: int = 3
    take_seed: int = FIRST_HELD_OUT_SEED + 900

    @property
    def seeds(self) -> range:
        """Seeds of the held-out scenes for policies."""
        return range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + self.num_seeds)


def demo_parser() -> CommandParser:
    """Parser of `dextouch demo`."""
    parser = CommandParser(
        prog="dextouch demo",
        epilog="example:\n  dextouch demo --output runs/demo --seeds 2",
        description="Record a human and a robot take through mock devices, align them, compare "
        "with ground truth, predict with the world model, and score policies in the twin and "
        "in the world model. Ends with a table, report.json and report.html; both takes stay in "
        f"the store {default_store()}, where the next run replaces them (DEXTOUCH_DATA sets "
        "another data folder).",
    )
    results = "folder of the results (%(default)s)"
    parser.add_argument("--output", type=Path, default=Path("demo"), metavar="FOLDER", help=results)
    add_json(parser)
    parser.add_argument(
        "--train",
        action="store_true",
        help="train a small state model, the policy and the probe instead of using the "
        "committed ones (takes much longer than the demo itself)",
    )
    scenes = "held-out scenes per task for scoring policies (%(default)s)"
    parser.add_argument("--seeds", type=int, metavar="N", default=6, help=scenes)
    return parser


def parse(argv: Sequence[str]) -> DemoPlan:
    """Parse the command line; `--help` prints the usage and exits."""
    parser = demo_parser()
    arguments = parser.parse_args(list(argv))
    if arguments.seeds < 1:
        parser.error(f"--seeds: got {arguments.seeds}, expected at least 1")
    return DemoPlan(arguments.output, arguments.json, arguments.train, arguments.seeds)
