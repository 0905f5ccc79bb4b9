"""Tables, charts and requirements of the acquisition benchmark."""

from collections.abc import Mapping, Sequence

from benchmarks.acquisition.drivers import DeviceTalk
from benchmarks.acquisition.noise import Judgement, Line
from benchmarks.acquisition.speed import READ_SIZES, WHOLE
from benchmarks.acquisition.starved import Load, Way
from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement, at_most
from benchmarks.report import ResultTable, cells

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


def starved_requirement(starved: Starved) -> Requirement:
    """Requirement on a HID device that a process of its own reads."""
    lost = 100 * starved["starved", "process"]["fingers"]
    return at_most("finger packets lost on a starved computer, reader process", lost, 1.0, "%")


def panels(judgements: Sequence[Judgement], speeds: Speeds) -> list[Panel]:
    """Time against wrong packets, one panel per family."""
    drawn = []
    for family in dict.fromkeys(judgement.family for judgement in judgements):
        points = [
            Point.of(
                found.way,
                speeds[family, found.way, WHOLE],
                100 * found.wrong_share,
                is_ours=found.way == OURS,
            )
            for found in judgements
            if found.family == family
        ]
        title = f"Decoding {family}"
        drawn.append(Panel(title, "µs a packet", "wrong packets of those delivered (%)", points))
    return drawn


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
