"""Requirements on decoders and serial ports, with measured values and verdicts."""

from collections.abc import Mapping, Sequence

from benchmarks.acquisition.drivers import DriverSpeed
from benchmarks.acquisition.noise import Judgement
from benchmarks.figures import Figure, Requirement

OURS = "ours"
CHECKED = ("dextouch", "wuji")
GLOVE = "glove "


def requirements(
    judgements: Sequence[Judgement],
    drivers: Sequence[DriverSpeed],
    split_differences: Mapping[str, int],
    core_share: Figure | None,
) -> list[Requirement]:
    """Build the table of requirements; some may be unmeasured in this run."""
    ours = {found.family: found for found in judgements if found.way == OURS}
    table = []
    for name in CHECKED:
        found = ours.get(name)
        many = "" if found is None else f" of {found.sent}"
        table += [
            Requirement(
                f"wrong packets{many}, {name}",
                None if found is None else float(found.wrong),
                "at most",
                0.0,
            ),
            Requirement(
                f"packets lost untouched{many}, {name}",
                None if found is None else float(found.collateral),
                "at most",
                0.0,
            ),
        ]
    table.append(
        Requirement(
            "ways of cutting the stream that change the packets, all families",
            float(sum(split_differences.values())) if split_differences else None,
            "at most",
            0.0,
        )
    )
    table += [
        Requirement(
            f"processor time a packet, {driver.name}",
            driver.time_us.median,
            "at most",
            15.0,
            "µs",
        )
        for driver in drivers
        if driver.name.startswith(GLOVE)
    ]
    share = None if core_share is None else core_share.median
    table.append(
        Requirement("core a stream, 8 gloves at 60 Hz on terminals", share, "at most", 1.0, "%")
    )
    return table
