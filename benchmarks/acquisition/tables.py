"""Tables and chart of the acquisition benchmark."""

from collections.abc import Mapping, Sequence

from benchmarks.acquisition.acceptance import OURS
from benchmarks.acquisition.drivers import DriverSpeed
from benchmarks.acquisition.noise import Judgement, Line
from benchmarks.acquisition.speed import READ_SIZES, WHOLE
from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure
from benchmarks.report import ResultTable

Speeds = Mapping[tuple[str, str, int], Figure]


def tables(
    judgements: Sequence[Judgement],
    speeds: Speeds,
    drivers: Sequence[DriverSpeed],
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
                    str(found.sent),
                    str(found.touched),
                    str(found.delivered),
                    str(found.wrong),
                    f"{100 * found.wrong_share:.3g}",
                    str(found.collateral),
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
                    driver.name,
                    f"{driver.packet_bytes:.0f}",
                    f"{driver.packet_reads:g}",
                    driver.time_us.text(),
                )
                for driver in drivers
            ],
        ),
        ResultTable(
            "Eight gloves at 60 Hz on pseudo terminals, one process",
            ("", "a stream (% of a core)"),
            [("open, read, stamp, decode", core_share.text())],
        ),
    ]


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
