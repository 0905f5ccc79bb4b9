"""Entry point of the benchmark stage `clocks`."""

import argparse
from dataclasses import asdict
from pathlib import Path

from benchmarks.clocks.compare import STAMPLESS, compare
from benchmarks.clocks.rivals import OFFLINE, ONLINE
from benchmarks.clocks.scenes import (
    MORE_SCENES,
    SCENES,
    SLEW_SCENES,
    STAMPLESS_SCENES,
    STOP_SCENES,
)
from benchmarks.clocks.scores import WARM_UP_S
from benchmarks.clocks.tables import panels, requirements, tables
from benchmarks.report import StageReport
from benchmarks.stages import Amounts, Bar, named

AMOUNTS = Amounts(usual={"seconds": 600.0, "rounds": 5}, quick={"seconds": 60.0, "rounds": 1})
# Online errors count after the warm-up, and a step comes in the middle.
MIN_SECONDS = 2 * WARM_UP_S + 2


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(parser, seconds="length of a take", rounds="takes per scene")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first round (%(default)s)")
    names = ", ".join([*SCENES, *MORE_SCENES, *STOP_SCENES, *SLEW_SCENES]).replace("%", "%%")
    parser.add_argument("--scenes", metavar="A,B", help=f"comma-separated scenes (all: {names})")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Run every method on every scene."""
    plan = AMOUNTS.of(options, seconds=MIN_SECONDS)
    scenes = SCENES | MORE_SCENES | STOP_SCENES | SLEW_SCENES
    if options.scenes is not None:
        scenes = named("scene", scenes | STAMPLESS_SCENES, options.scenes)
    seconds, seeds = plan["seconds"], range(options.seed, options.seed + plan["rounds"])
    results = compare(scenes, ONLINE | OFFLINE, seconds, seeds, bar)
    stampless = compare(STAMPLESS_SCENES, STAMPLESS, seconds, seeds, bar)
    return StageReport(
        stage="clocks",
        packages=("numpy",),
        options={**plan, "seed": options.seed, "scenes": list(scenes)},
        tables=tables(results, stampless),
        panels=panels(results),
        requirements=requirements(results, stampless),
        data={
            "results": [
                {
                    "scene": result.scene,
                    "way": result.way,
                    "rounds": [asdict(score) for score in result.scores],
                    "us_per_sample": list(result.us_per_sample.values),
                }
                for result in (*results, *stampless)
            ]
        },
        notes=[
            f"online errors exclude the first {WARM_UP_S:g} s and, in scenes with a step, 1.2 s "
            "after it; each round is a take with a different seed"
        ],
    )
