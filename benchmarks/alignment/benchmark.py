"""Entry point of the benchmark stage `alignment`."""

import argparse
from dataclasses import asdict
from pathlib import Path

from benchmarks.alignment.compare import compare
from benchmarks.alignment.recordings import record
from benchmarks.alignment.tables import panels, requirements, tables
from benchmarks.report import StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.errors import InvalidInputError
from services.alignment.retargeting.hand_retargeter import warm_up

QUICK_SECONDS, USUAL_SECONDS = "3", "10,60"
AMOUNTS = Amounts(usual={"rounds": 5}, quick={"rounds": 1})
# Shorter takes have no stretch of 17 steps.
MIN_SECONDS = 2.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    parser.add_argument(
        "--seconds",
        metavar="A,B",
        help=f"lengths of the takes ({USUAL_SECONDS}; quick {QUICK_SECONDS})",
    )
    AMOUNTS.add_options(parser, rounds="rounds a take")
    parser.add_argument("--seed", type=int, default=0, help="random seed (%(default)s)")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Record takes, then align each alternately with every method."""
    lengths_s = _lengths_s(options)
    num_rounds = AMOUNTS.of(options)["rounds"]
    takes = []
    with bar("recording", len(lengths_s)) as step:
        for seconds in lengths_s:
            step(f"{seconds:g} s")
            takes.append(record(seconds, options.seed, folder / f"take_{seconds:g}s"))
    warm_up()
    results = [compare(take, num_rounds, folder, bar=bar) for take in takes]
    longest = results[-1]
    return StageReport(
        stage="alignment",
        packages=("numpy", "numba", "scipy", "zstandard"),
        options={"seconds": lengths_s, "rounds": num_rounds, "seed": options.seed},
        tables=tables(results),
        panels=panels(longest),
        requirements=requirements(longest),
        data={"takes": [{name: asdict(one) for name, one in found.items()} for found in results]},
        notes=[
            "processor time of all threads, so multiples of real time refer to one core; clock "
            "fits are timed separately after the alignment and subtracted from the calibration",
            "gloves are calibrated with a take under known pressures and by time requests, other "
            "path delays have errors of 0.2 ms (sigma); the transfer over HTTP is not included",
        ],
    )


def _lengths_s(options: argparse.Namespace) -> list[float]:
    text = options.seconds or (QUICK_SECONDS if options.quick else USUAL_SECONDS)
    words = [word.strip() for word in text.split(",")]
    try:
        lengths_s = sorted({float(word) for word in words})
    except ValueError:
        lengths_s = []
    if not lengths_s or not MIN_SECONDS <= lengths_s[0] <= lengths_s[-1] < float("inf"):
        raise InvalidInputError(
            f"--seconds: got {text!r}, expected lengths of at least {MIN_SECONDS:g} s, like 10,60"
        )
    return lengths_s
