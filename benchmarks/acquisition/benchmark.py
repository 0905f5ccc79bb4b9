"""The benchmark stage `acquisition`: its measurements, tables and requirements."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.acquisition.decoders import (
    READ_SIZES,
    DeviceTalk,
    Judgement,
    Line,
    count_split_differences,
    judge,
    make_families,
    make_talks,
    measure_drivers,
    measure_speed,
)
from benchmarks.acquisition.starved import NUM_STREAMS, Load, Way, run_ptys, run_starved
from benchmarks.figures import Figure, Requirement, at_most
from benchmarks.report import ResultTable, StageReport, cells
from benchmarks.stages import Amounts, Bar

OURS = "ours"
CHECKED = ("dextouch", "wuji")
GLOVE = "glove "
Starved = Mapping[tuple[Load, Way], Mapping[str, float]]
Speeds = Mapping[tuple[str, str, int], Figure]


def tables(
    judgements: Sequence[Judgement],
    speeds: Speeds,
    talks: Sequence[DeviceTalk],
    driver_us: Mapping[str, Figure],
    *,
    line: Line,
    core_share: Figure,
) -> list[ResultTable]:
    """All tables of the stage."""
    sizes = [f"{size} B" if size else "a packet" for size in READ_SIZES]
    ways = list(dict.fromkeys((family, way) for family, way, _ in speeds))
    return [
        ResultTable(
            f"A line with bit error rate {line.bit_error_rate:g} and byte loss "
            f"{line.byte_loss_rate:g} (wrong: never sent so; collateral: lost though untouched)",
            ("family, way", "sent", "touched", "delivered", "wrong", "wrong (%)", "collateral"),
            [
                (
                    f"{found.family}, {found.way}",
                    *cells(found.sent, found.touched, found.delivered, found.wrong),
                    *cells(100 * found.wrong_share, found.collateral),
                )
                for found in judgements
            ],
        ),
        ResultTable(
            "Processor time of gloves' packets (µs), by bytes a read",
            ("family, way", *sizes),
            [
                (f"{family}, {way}", *(speeds[family, way, size].text() for size in READ_SIZES))
                for family, way in ways
            ],
        ),
        ResultTable(
            "Processor time of every driver, from the bytes of a read to samples",
            ("driver", "bytes a packet", "reads a packet", "a packet (µs)"),
            [
                (
                    talk.name,
                    f"{talk.packet_bytes:.0f}",
                    f"{talk.packet_reads:g}",
                    driver_us[talk.name].text(),
                )
                for talk in talks
            ],
        ),
        ResultTable(
            "Eight gloves at 60 Hz on pseudo terminals, one process",
            ("", "a stream (% of a core)"),
            [("open, read, stamp, decode", core_share.text())],
        ),
    ]


def starved_table(starved: Starved) -> ResultTable:
    """Packets lost where busy threads and processes take the processors."""
    return ResultTable(
        "Finger tracker (HID) and glove (serial) among 4 busy threads and 4 busy processes "
        "(starved), or alone (idle), by what reads the HID device",
        ("load, HID reader", "fingers lost (%)", "glove lost (%)", "reader process (% of a core)"),
        [
            (
                f"{load}, {way}",
                *cells(100 * found["fingers"], 100 * found["glove"], 100 * found["reader_cpu"]),
            )
            for (load, way), found in starved.items()
        ],
    )


def requirements(
    judgements: Sequence[Judgement],
    driver_us: Mapping[str, Figure],
    split_differences: Mapping[str, int],
    core_share: Figure,
) -> list[Requirement]:
    """Requirements on our decoders and drivers."""
    ours = {found.family: found for found in judgements if found.way == OURS}
    table = []
    for name in CHECKED:
        found = ours[name]
        table += [
            at_most(f"wrong packets of {found.sent}, {name}", float(found.wrong), 0.0),
            at_most(
                f"packets lost untouched of {found.sent}, {name}", float(found.collateral), 0.0
            ),
        ]
    what = "ways of cutting the stream that change the packets, all families"
    return [
        *table,
        at_most(what, float(sum(split_differences.values())), 0.0),
        *(
            at_most(f"processor time a packet, {name}", time_us.median, 15.0, "µs")
            for name, time_us in driver_us.items()
            if name.startswith(GLOVE)
        ),
        at_most("core a stream, 8 gloves at 60 Hz on terminals", core_share.median, 1.0, "%"),
    ]


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
        requirements=[
            *requirements(judgements, driver_us, splits, share),
            at_most(
                "finger packets lost on a starved computer, reader process",
                100 * starved["starved", "process"]["fingers"],
                1.0,
                "%",
            ),
        ],
        data={
            "line": LINE,
            "judgements": judgements,
            "split_differences": splits,
            "us_a_packet": [
                {"family": family, "way": way, "read_bytes": size, "rounds": figure}
                for (family, way, size), figure in speeds.items()
            ],
            "drivers": [_row(talk, driver_us[talk.name]) for talk in talks],
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


def _row(talk: DeviceTalk, us_a_packet: Figure) -> dict[str, object]:
    return {
        "driver": talk.name,
        "packet_bytes": talk.packet_bytes,
        "packet_reads": talk.packet_reads,
        "us_a_packet": us_a_packet,
    }
