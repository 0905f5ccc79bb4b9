"""Entry point of the benchmark stage `store`."""

import argparse
from dataclasses import asdict
from pathlib import Path

from benchmarks.report import StageReport
from benchmarks.stages import Amounts, Bar, named
from benchmarks.store.appends import measure_appends
from benchmarks.store.compare import Effort, compare
from benchmarks.store.designs import Design
from benchmarks.store.live import write_live
from benchmarks.store.mcap_design import McapDesign
from benchmarks.store.our_design import OurDesign
from benchmarks.store.tables import OURS, panels, requirements, tables
from benchmarks.store.take import make_take
from benchmarks.store.workload import CAMERAS
from benchmarks.store.zarr_design import ZarrDesign

DESIGNS: tuple[Design, ...] = (
    OurDesign("h264"),
    OurDesign("jpeg"),
    ZarrDesign("jpeg"),
    ZarrDesign("jpeg-pool"),
    ZarrDesign("raw"),
    McapDesign(),
)
AMOUNTS = Amounts(
    usual={"seconds": 10.0, "rounds": 5, "windows": 40},
    quick={"seconds": 2.0, "rounds": 1, "windows": 4},
)
# More than the length of a window.
_MIN_SECONDS = 1.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    names = ",".join(design.name for design in DESIGNS)
    AMOUNTS.add_options(
        parser, seconds="length of the take", rounds="rounds", windows="random windows per round"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the scene (%(default)s)")
    parser.add_argument(
        "--designs", metavar="A,B", help=f"comma-separated designs (all available: {names})"
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Write and read one take with every design, then appends and the live run."""
    plan = AMOUNTS.of(options, seconds=_MIN_SECONDS)
    known = {design.name: design for design in DESIGNS}
    chosen = known if options.designs is None else named("design", known, options.designs)
    notes = [f"{d.name} is skipped: needs {d.missing()}" for d in chosen.values() if d.missing()]
    designs = [design for design in chosen.values() if design.missing() is None]
    with bar("generating the scene", len(CAMERAS)) as step:
        workload = make_take(plan["seconds"], options.seed, on_camera=step)
    effort = Effort(plan["rounds"], plan["windows"], 1 if options.quick else 3, options.seed)
    results = compare(designs, workload, folder, effort, bar)
    share = 0.1 if options.quick else 1.0
    appends = measure_appends(workload, folder, plan["rounds"], bar, share=share)
    live = []
    with bar("live", plan["rounds"]) as step:
        for index in range(plan["rounds"]) if OURS in results else ():
            step(f"run {index + 1}")
            live.append(write_live(workload, folder / "live"))
    return StageReport(
        stage="store",
        packages=("numpy", "simplejpeg", "av", "zarr", "zstandard", "mcap"),
        options={**plan, "seed": options.seed, "designs": [design.name for design in designs]},
        tables=tables(results, appends, live),
        panels=panels(results),
        requirements=requirements(results, appends, live),
        data={
            "designs": {name: asdict(result) for name, result in results.items()},
            "appends": [asdict(append) for append in appends],
            "live": [asdict(run) for run in live],
        },
        notes=notes,
    )
