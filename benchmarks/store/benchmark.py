"""The benchmark stage `store`: its measurements, tables and requirements."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import astuple
from pathlib import Path

from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement, at_least, at_most
from benchmarks.report import ResultTable, StageReport, cells
from benchmarks.stages import Amounts, Bar, named
from benchmarks.store.compare import (
    SPEED,
    SPOOL,
    SPOOL_SYNCED,
    AppendResult,
    DesignResult,
    Effort,
    LiveResult,
    compare,
    measure_appends,
    write_live,
)
from benchmarks.store.designs import Design, McapDesign, OurDesign, ZarrDesign
from benchmarks.store.workload import CAMERAS, make_take

# The default configuration that requirements refer to, and the design compared with.
OURS, RIVAL = "ours-h264", "zarr-jpeg"


def tables(
    results: Mapping[str, DesignResult],
    appends: Sequence[AppendResult],
    live: Sequence[LiveResult],
) -> list[ResultTable]:
    """All tables of the stage; those without rows are omitted."""
    found = [
        write_table(results),
        read_table(results),
        ResultTable(
            "Appending one glove sample (ms)",
            ("way", "p50", "p99", "appends a round"),
            [(a.name, *cells(a.p50_ms, a.p99_ms, a.num_appends)) for a in appends],
        ),
        ResultTable(
            "Live recording of a full station (late: accepted more than 0.1 s after it was due)",
            ("speed", "rows", "late", "dropped", "worst lag (ms)", "closing (s)"),
            [cells(*astuple(run)) for run in live],
        ),
    ]
    return [table for table in found if table.rows]


def write_table(results: Mapping[str, DesignResult]) -> ResultTable:
    """Time, bytes and image error of writing: medians, with the spread of the rounds."""
    rows = [
        (
            result.name,
            result.write_s.inverse(result.seconds).text(),
            result.cpu_s.scaled(1 / result.seconds).text(),
            _megabytes(result),
            str(result.num_files),
            " ".join(f"{decibels:.1f}" for decibels in result.psnr_db.values()),
        )
        for result in results.values()
    ]
    return ResultTable(
        "Writing (speed: 1 is real time; CPU per recorded second; PSNR: head, left, right)",
        ("design", "speed", "CPU (s)", "MB/min", "files", "PSNR (dB)"),
        rows,
    )


def read_table(results: Mapping[str, DesignResult]) -> ResultTable:
    """How many windows a second: medians, with the spread of the rounds."""
    rows = [
        (
            result.name,
            result.window_ms.inverse(1e3).text(),
            result.three_cameras_ms.inverse(1e3).text(),
            result.three_cameras_threaded_ms.inverse(1e3).text(),
            "" if result.touch_ms is None else result.touch_ms.text(),
        )
        for result in results.values()
    ]
    return ResultTable(
        "Random windows of 17 images per second, and time for their touch",
        ("design", "1 camera", "3 cameras", "3, threads", "touch (ms)"),
        rows,
    )


def panels(results: Mapping[str, DesignResult]) -> list[Panel]:
    """Time against image error, for writing and for reading."""
    write = {name: result.write_s.scaled(1 / result.seconds) for name, result in results.items()}
    read = {name: result.window_ms for name, result in results.items()}
    error = "image error (RMS, levels of 255)"
    return [
        Panel("Writing", "seconds a recorded second", error, _points(results, write)),
        Panel("Reading, one camera", "ms a window of 17 images", error, _points(results, read)),
    ]


def _points(results: Mapping[str, DesignResult], times: Mapping[str, Figure]) -> list[Point]:
    return [
        Point.of(
            f"{name}, {_megabytes(result)} MB/min",
            times[name],
            rms_levels(result.mean_psnr_db),
            is_ours=name.startswith("ours"),
        )
        for name, result in results.items()
    ]


def rms_levels(psnr_db: float) -> float:
    """Root mean square error (levels of 8-bit images) for a PSNR."""
    return float(255.0 * 10.0 ** (-psnr_db / 20.0))


def _megabytes(result: DesignResult) -> str:
    return f"{result.num_bytes / 1e6 * 60 / result.seconds:.0f}"


def requirements(
    results: Mapping[str, DesignResult],
    appends: Sequence[AppendResult],
    live: Sequence[LiveResult],
) -> list[Requirement]:
    """Build the table of requirements; some may be unmeasured in this run."""
    ours, rival = results.get(OURS), results.get(RIVAL)
    return [
        *_against_rival(ours, rival),
        at_most(
            "processor seconds of writing a recorded second",
            None if ours is None else ours.cpu_s.median / ours.seconds,
            0.35,
            "s",
        ),
        at_most(
            f"rows late or dropped, station live at {SPEED:g} times real time",
            float(max(run.num_late + run.num_dropped for run in live)) if live else None,
            0.0,
        ),
        _append("numeric append, p99", SPOOL, appends, bound_ms=0.1),
        _append("numeric append on the disk, p99", SPOOL_SYNCED, appends, bound_ms=1.0),
        at_most(
            "34 samples of both gloves at native rate",
            None if ours is None or ours.touch_ms is None else ours.touch_ms.median,
            0.4,
            "ms",
        ),
    ]


def _against_rival(ours: DesignResult | None, rival: DesignResult | None) -> list[Requirement]:
    write = bytes_ = decibels = windows = None
    if ours is not None and rival is not None:
        write = rival.write_s.over(ours.write_s).median
        bytes_ = ours.num_bytes / rival.num_bytes
        decibels = rival.mean_psnr_db - ours.mean_psnr_db
        windows = rival.window_ms.over(ours.window_ms).median
    return [
        at_least(f"write speed, times {RIVAL}", write, 2.0),
        at_most(f"bytes, times {RIVAL}", bytes_, 0.2),
        at_most(f"mean PSNR below {RIVAL}", decibels, 2.0, "dB"),
        at_least(f"one-camera windows a second, times {RIVAL}", windows, 1.8),
    ]


def _append(
    what: str, way: str, appends: Sequence[AppendResult], *, bound_ms: float
) -> Requirement:
    found = [append.p99_ms.median for append in appends if append.name == way]
    return at_most(what, found[0] if found else None, bound_ms, "ms")


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
        data={"designs": results, "appends": appends, "live": live},
        notes=notes,
    )
