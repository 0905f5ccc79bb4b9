"""HTML page of a report (the content of report.json) and its pictures, in one file.

Every section is optional and omitted without data. The report may hold `title`, `about`, `stages`,
`errors`, `world_model`, `prediction`, `policies`, `agreement` and `failures`; unknown keys only
appear in the raw figures at the end.
"""

import json
import os
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dextouch import __version__
from dextouch.free_text import printable
from services.evaluation.agreement import FIGURES
from services.evaluation.rendering import environment
from services.evaluation.reporting import sections
from services.evaluation.reporting.pictures import (
    FULL_SCALE_KPA,
    MAX_MOVING,
    ReportPictures,
    action_charts,
    clock_chart,
    moments,
    moving_picture,
    policy_panels,
    scale_colours,
)


def write_report(report: Mapping[str, Any], pictures: ReportPictures, path: Path) -> None:
    """Write the page atomically; NaN and None are shown as "undefined"."""
    # Texts from elsewhere with their unusual characters escaped; drawings and numbers as given.
    pages = environment().overlay(
        finalize=lambda value: printable(value, lines=True) if type(value) is str else value
    )
    text = pages.get_template("report.html.j2").render(
        raw_report=report,
        tiles=sections.tiles(report),
        errors=sections.error_rows(report.get("errors", {})),
        error_kinds=sections.ERRORS,
        clocks=sections.clock_rows(report.get("errors", {})),
        clock_chart=clock_chart(pictures),
        action_charts=action_charts(pictures.actions),
        comparisons=sections.comparison_bars(report.get("world_model", {})),
        policies=policy_panels(report),
        agreement_figures=FIGURES,
        failures=sections.failure_rows(report),
        undecided_note=sections.undecided_note,
        pictures=pictures,
        moments=moments,
        moving=[moving_picture(pair) for pair in pictures.moving[:MAX_MOVING]],
        scale=scale_colours(),
        full_scale_kpa=FULL_SCALE_KPA,
        written=datetime.now(UTC),
        machine=f"{platform.node()} ({platform.system()} {platform.machine()}, "
        f"{os.cpu_count()} cores)",
        version=__version__,
        raw=json.dumps(report, indent=1, default=str, ensure_ascii=False),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)
