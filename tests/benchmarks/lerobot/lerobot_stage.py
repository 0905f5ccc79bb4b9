"""The stage `lerobot` of the benchmark: our store beside LeRobotDataset v3; a report out."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from environment import enter
from lerobot_designs import DIRECT, STREAMING, lerobot_designs

from benchmarks.figures import Requirement
from benchmarks.report import StageReport
from benchmarks.stages import Bar
from benchmarks.store.benchmark import panels, read_table, write_table
from benchmarks.store.compare import DesignResult, Effort, compare
from benchmarks.store.designs import Design, OurDesign
from benchmarks.store.workload import CAMERAS, make_take
from dextouch.errors import UnknownNameError

OURS = "ours-h264"
NOTES = (
    "LeRobot has one rate: its files hold no native time stamps and nine of ten 100 Hz poses.",
    "LeRobot's item decodes one image of each other camera too, in threads of its own.",
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    names = ",".join(design.name for design in _designs())
    parser.add_argument("--seconds", type=float, help="length of the take (10; quick 2)")
    parser.add_argument("--rounds", type=int, help="rounds (3; quick 1)")
    parser.add_argument("--windows", type=int, help="random windows a round (40; quick 4)")
    parser.add_argument("--seed", type=int, default=0, help="of the scene (%(default)s)")
    parser.add_argument("--designs", metavar="A,B", help=f"comma-separated designs (all: {names})")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Write and read one take with every design in turns.

    Raises:
        UnknownNameError: a design that there is not.
        InvalidInputError: no round.
    """
    enter(folder / "cache")
    chosen = _choose(options.designs)
    designs = [design for design in chosen if design.missing() is None]
    notes = [f"{d.name} is skipped: needs {d.missing()}" for d in chosen if d.missing()]
    seconds = options.seconds or (2.0 if options.quick else 10.0)
    effort = Effort(
        num_rounds=options.rounds or (1 if options.quick else 3),
        num_windows=options.windows or (4 if options.quick else 40),
        num_compared=1 if options.quick else 3,
        seed=options.seed,
    )
    with bar("generating the scene", len(CAMERAS)) as step:
        workload = make_take(seconds, options.seed, on_camera=step)
    results = compare(designs, workload, folder, effort, bar)
    return StageReport(
        stage="lerobot",
        packages=("lerobot", "torch", "torchcodec", "datasets", "pyarrow", "av", "numpy"),
        options={"seconds": seconds, **asdict(effort), "designs": list(results)},
        tables=[write_table(results), read_table(results)],
        panels=panels(results),
        requirements=requirements(results),
        data={"designs": {name: asdict(result) for name, result in results.items()}},
        notes=[*quality_notes(results), *NOTES, *notes],
    )


def requirements(results: Mapping[str, DesignResult]) -> list[Requirement]:
    """What the store promises over LeRobot's streaming writer; the tuned one has no bound."""
    ours, rival = results.get(OURS), results.get(STREAMING)
    write, num_bytes, windows = _ratios(ours, rival)
    return [
        Requirement(f"write speed over {STREAMING}", write, "at least", 4.0, "times"),
        Requirement(f"bytes over {STREAMING}", num_bytes, "at most", 0.7, "times"),
        Requirement(
            f"one-camera windows a second over {STREAMING}", windows, "at least", 6.0, "times"
        ),
    ]


def _ratios(
    ours: DesignResult | None, rival: DesignResult | None
) -> tuple[float | None, float | None, float | None]:
    """Write speed, bytes and windows of ours as multiples of the rival's."""
    if ours is None or rival is None:
        return None, None, None
    return (
        rival.write_s.over(ours.write_s).median,
        ours.num_bytes / rival.num_bytes,
        rival.window_ms.over(ours.window_ms).median,
    )


def quality_notes(results: Mapping[str, DesignResult]) -> list[str]:
    """How our images compare with each rival's: bytes mean little without it."""
    ours = results.get(OURS)
    if ours is None:
        return []
    return [
        f"{OURS}: mean PSNR {ours.mean_psnr_db - rival.mean_psnr_db:+.2f} dB, "
        f"{ours.num_bytes / rival.num_bytes:.3f} times the bytes of {rival.name}"
        for rival in results.values()
        if rival is not ours and not rival.name.endswith(DIRECT)
    ]


def _designs() -> list[Design]:
    return [OurDesign("h264"), *lerobot_designs()]


def _choose(names: str | None) -> Sequence[Design]:
    known = {design.name: design for design in _designs()}
    wanted = list(known) if names is None else [name.strip() for name in names.split(",")]
    for name in wanted:
        if name not in known:
            raise UnknownNameError("design", name, list(known))
    return [known[name] for name in wanted]
