"""Entry point of the benchmark stage `acquisition`."""

import argparse
from dataclasses import asdict
from pathlib import Path

from benchmarks.acquisition.drivers import make_talks, measure_drivers
from benchmarks.acquisition.families import make_families
from benchmarks.acquisition.noise import Line, count_split_differences, judge
from benchmarks.acquisition.ptys import NUM_STREAMS, run_ptys
from benchmarks.acquisition.speed import measure_speed
from benchmarks.acquisition.starved import Load, Way, run_starved
from benchmarks.acquisition.tables import (
    panels,
    requirements,
    starved_requirement,
    starved_table,
    tables,
)
from benchmarks.figures import Figure
from benchmarks.report import StageReport
from benchmarks.stages import Amounts, Bar

LINE = Line(bit_error_rate=1e-5, byte_loss_rate=1e-5)
AMOUNTS = Amounts(
    usual={"packets": 100_000, "rounds": 7, "seconds": 5.0, "splits": 60},
    quick={"packets": 2000, "rounds": 1, "seconds": 1.0, "splits": 5},
)
_NUM_PTY_ROUNDS = 3
STARVED: tuple[tuple[Load, Way], ...] = (
    ("idle", "process"),
    ("starved", "thread"),
    ("starved", "process"),
)
_BLOCKS = 500


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(
        parser,
        packets="packets per family",
        rounds="timing rounds",
        seconds="length of three runs",
        splits="random splits",
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed (%(default)s)")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Decode from a noisy line, time every decoder and driver, read eight gloves."""
    plan = AMOUNTS.of(options, packets=5, seconds=1e-3)
    seed = options.seed
    families = make_families()
    with bar("bad line", len(families) * -(-plan["packets"] // _BLOCKS)) as step:
        judgements = [
            found
            for family in families
            for found in judge(family, LINE, plan["packets"], seed=seed, on_block=step)
        ]
    splits = {
        family.name: count_split_differences(family, LINE, plan["splits"], seed=seed)
        for family in families
    }
    num_subjects = plan["rounds"] * 3 * sum(len(family.ways) for family in families)
    with bar("timing", num_subjects) as step:
        speeds = measure_speed(families, plan["rounds"], seed=seed, on_step=step)
    talks = make_talks(seed=seed)
    with bar("every driver", plan["rounds"] * len(talks)) as step:
        driver_us = measure_drivers(talks, plan["rounds"], on_step=step)
    runs = []
    num_pty_rounds = 1 if options.quick else _NUM_PTY_ROUNDS
    with bar("eight gloves", num_pty_rounds) as step:
        for index in range(num_pty_rounds):
            step(f"run {index + 1}")
            runs.append(run_ptys(plan["seconds"]))
    starved = {}
    with bar("starved computer", len(STARVED)) as step:
        for load, way in STARVED:
            step(f"{load}, {way}")
            starved[load, way] = run_starved(load, way, plan["seconds"])
    share = Figure.of([100 * run["cpu_s"] / run["seconds"] / NUM_STREAMS for run in runs])
    return StageReport(
        stage="acquisition",
        packages=("numpy", "pyserial"),
        options={**plan, "seed": seed},
        tables=[
            *tables(judgements, speeds, talks, driver_us, line=LINE, core_share=share),
            starved_table(starved),
        ],
        panels=panels(judgements, speeds),
        requirements=[
            *requirements(judgements, driver_us, splits, share),
            starved_requirement(starved),
        ],
        data={
            "line": asdict(LINE),
            "judgements": [asdict(found) for found in judgements],
            "split_differences": splits,
            "us_a_packet": [
                {"family": family, "way": way, "read_bytes": size, "rounds": list(figure.values)}
                for (family, way, size), figure in speeds.items()
            ],
            "drivers": [
                {
                    "driver": talk.name,
                    "packet_bytes": talk.packet_bytes,
                    "packet_reads": talk.packet_reads,
                    "us_a_packet": list(driver_us[talk.name].values),
                }
                for talk in talks
            ],
            "eight_gloves": runs,
            "starved": [
                {"load": load, "way": way, **found} for (load, way), found in starved.items()
            ],
        },
        notes=[
            "justfloat has no checksum: no decoder can detect errors that leave a plausible "
            "reading; the stream's capabilities declare this",
            "camera times include the quality checks; one in 10 JPEG images is decoded",
        ],
    )
