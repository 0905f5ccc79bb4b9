"""Entry point of the benchmark stage `retargeting`."""

import argparse
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from benchmarks.report import StageReport
from benchmarks.retargeting.compare import (
    Effort,
    compare_axes,
    compare_pinches,
    compare_robot,
    compare_speed,
    pinch_set,
    robot_sets,
)
from benchmarks.retargeting.ours import OURS_EXACT, cold_start
from benchmarks.retargeting.rival_process import NUM_WARM_UP, RivalProcess
from benchmarks.retargeting.rivals import INSTALL, RIVALS, Rival, missing_modules
from benchmarks.retargeting.robustness import try_faults
from benchmarks.retargeting.tables import axes_tables, panels, requirements, tables
from benchmarks.stages import Amounts, Bar, named
from dextouch.errors import InvalidInputError

AMOUNTS = Amounts(
    usual={"seeds": 2, "samples": 600, "people": 5, "rounds": 6, "postures": 5000},
    quick={"seeds": 1, "samples": 120, "people": 1, "rounds": 1, "postures": 100},
)
_NONE = "none"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(parser, rounds="timing rounds", samples="of a motion")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the first motion (%(default)s)"
    )
    parser.add_argument(
        "--rivals",
        metavar="A,B",
        help=f"comma-separated libraries, or {_NONE} (all that are installed: {', '.join(RIVALS)})",
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Run every method on robot motions, on pinching people and on those of other axes."""
    if options.seed < 0:
        raise InvalidInputError(f"--seed: got {options.seed}, expected at least 0")
    plan = AMOUNTS.of(options, samples=30)
    effort = Effort(**{f"num_{name}": one for name, one in plan.items()}, seed=options.seed)
    chosen, left_out = choose_rivals(options.rivals)
    with ExitStack() as stack:
        rivals = {one.name: stack.enter_context(RivalProcess(one)) for one in chosen}
        speeds = compare_speed(effort, rivals, bar)
        robot = compare_robot(robot_sets(effort), rivals, bar)
        pinches = compare_pinches(pinch_set(effort), rivals, bar)
        axes = compare_axes(effort, rivals, bar)
        outcomes = try_faults(effort.seed, rivals, bar)
    cold = cold_start(effort.num_postures, effort.seed)
    return StageReport(
        stage="retargeting",
        packages=("numpy", "numba", "dex-retargeting", "nlopt", "pin", "torch", "dexi-rs"),
        options={**asdict(effort), "rivals": list(rivals)},
        tables=[
            *tables(speeds, robot, pinches, cold, outcomes, list(rivals)),
            *axes_tables(axes, list(rivals)),
        ],
        panels=panels(speeds, robot, pinches),
        requirements=requirements(speeds, robot, pinches, cold),
        data={
            "speed": [asdict(speed) for speed in speeds],
            "robot": {
                name: {method: asdict(score) for method, score in scores.items()}
                for name, scores in robot.items()
            },
            "pinches": {method: asdict(score) for method, score in pinches.items()},
            "oblique_axes": {
                f"{oblique_deg:g}": {method: asdict(score) for method, score in scores.items()}
                for oblique_deg, scores in axes.items()
            },
            "cold_start": cold._asdict(),
            "faults": [asdict(outcome) for outcome in outcomes],
        },
        notes=notes(chosen, left_out),
    )


def choose_rivals(words: str | None) -> tuple[list[Rival], list[Rival]]:
    """The rivals of `--rivals` that are installed, and those that are not.

    Raises:
        UnknownNameError: a rival that there is not.
    """
    wanted = list(RIVALS.values())
    if words is not None:
        wanted = [] if words == _NONE else list(named("rival", RIVALS, words).values())
    left_out = [rival for rival in wanted if missing_modules(rival)]
    return [rival for rival in wanted if rival not in left_out], left_out


def notes(chosen: list[Rival], left_out: list[Rival]) -> list[str]:
    """Notes on how methods were run, and why some were skipped."""
    told = [
        f"{OURS_EXACT} is without temporal regularization; times assume a known profile of the "
        "person, errors a profile measured from the same samples"
    ]
    if chosen:
        told.append(
            "other libraries run in separate processes, sample by sample, without their low-pass "
            f"filter, and after {NUM_WARM_UP} warm-up calls with the first sample; their keypoints "
            "are scaled by the lengths of the fingers; ours has a cold start"
        )
    if left_out:
        missing = sorted({module for rival in left_out for module in missing_modules(rival)})
        told.append(
            f"{', '.join(rival.name for rival in left_out)} not measured: "
            f"{', '.join(missing)} not installed; {INSTALL}"
        )
    return told
