"""Report of an alignment: clocks, retargeting quality and parts that are not in the episode.

As data, as one line of text, and as tables for a terminal.
"""

import re
from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import Field, FiniteFloat
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from dextouch.episodes import EpisodeReader
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import ClockReport, Domain, Matrix
from services.alignment.calibration.tactile_tare import REASONS
from services.alignment.synchronization.refused_parts import RefusedPart, refused_parts

EXPECTED_STREAMS = (
    "tactile_left",
    "tactile_right",
    "camera_head",
    "camera_wrist_left",
    "camera_wrist_right",
)
# Taxels for each reason, and refused parts, that a page lists; the report has all.
MAX_LISTED = 12
WHY = {
    "late_start": "began later than the others",
    "early_end": "ended earlier than the others",
    "gap": "no samples",
    "shorter": "a longer stretch without a gap was taken",
}


class AlignmentReport(FrozenModel):
    """Report of one aligned recording.

    `created` is False where the same recording had been aligned with the same options before.
    `duration_s` is that of the model grid. `absent` lists streams that an episode may have and this
    one has not; `refused_parts` the stretches of the recording that are not in the episode, and
    why; `retargeting` figures of each hand: tip error (mean and 95th percentile, mm) and the share
    of steps by status. `refused_taxels` names, by stream and reason, taxels (anatomical order) that
    are zero because they were not measured.
    """

    recording_id: str
    episode_id: str
    created: bool
    domain: Domain
    num_steps: int
    duration_s: float = Field(default=0.0, ge=0)
    streams: dict[str, int]
    absent: tuple[str, ...]
    clocks: tuple[ClockReport, ...]
    quality: dict[str, FiniteFloat]
    retargeting: dict[str, dict[str, FiniteFloat]] = Field(default={})
    refused_parts: tuple[RefusedPart, ...] = ()
    refused_taxels: dict[str, dict[str, tuple[int, ...]]] = Field(default={})
    content_sha256: str


def report_of(episode: EpisodeReader, *, recording_id: str, created: bool) -> AlignmentReport:
    """The report of an episode that alignment wrote."""
    attributes = episode.attributes
    return AlignmentReport(
        recording_id=recording_id,
        episode_id=attributes.episode_id,
        created=created,
        domain=attributes.domain,
        num_steps=episode.num_steps,
        duration_s=episode.num_steps / attributes.model_rate_hz,
        streams={name: episode.num_samples(name) for name in episode.streams},
        absent=tuple(name for name in EXPECTED_STREAMS if name not in episode.streams),
        clocks=attributes.clocks,
        quality=attributes.quality,
        retargeting=_retargeting_figures(attributes.quality),
        refused_parts=refused_parts(attributes.calibration),
        refused_taxels=_refused_taxels(attributes.calibration),
        content_sha256=episode.content_sha256,
    )


def _retargeting_figures(quality: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """By side; empty where nothing was retargeted."""
    found: dict[str, dict[str, float]] = {}
    for name, value in quality.items():
        if match := re.fullmatch(r"retargeting_(left|right)_(.+)", name):
            found.setdefault(match[1], {})[match[2]] = value
    return found


def _refused_taxels(calibration: Mapping[str, Matrix]) -> dict[str, dict[str, tuple[int, ...]]]:
    """By stream and reason."""
    found: dict[str, dict[str, tuple[int, ...]]] = {}
    for name in ("tactile_left", "tactile_right"):
        states = np.array(calibration.get(f"{name}_refused_taxels", ()), dtype=np.int64).ravel()
        for code in np.unique(states[states > 0]).tolist():
            taxels = tuple(np.flatnonzero(states == code).tolist())
            found.setdefault(name, {})[REASONS[code]] = taxels
    return found


def report_line(report: AlignmentReport) -> str:
    """A report as one line of text."""
    verb = "aligned" if report.created else "was aligned already"
    lost = sum(clock.num_dropped for clock in report.clocks)
    absent = f"; absent: {', '.join(report.absent)}" if report.absent else ""
    refused = "".join(
        f"; {stream}: taxels not measured and zero: {_by_reason(reasons)}"
        for stream, reasons in report.refused_taxels.items()
    )
    doubts = "".join(f"; {doubt}" for doubt in _doubts(report))
    return (
        f"{report.recording_id} {verb}: {report.episode_id}, {report.num_steps} steps, "
        f"{len(report.streams)} streams, {lost} samples lost{absent}{refused}{doubts}"
    )


def report_page(report: AlignmentReport) -> Group:
    """A report as tables for the terminal."""
    return Group(
        Text(f"{report.recording_id} → {report.episode_id}", style="bold"),
        Text(
            f"{report.domain}, {report.num_steps} steps, {report.duration_s:.1f} s; absent: "
            f"{', '.join(report.absent) or 'nothing'}"
        ),
        _clocks(report),
        *map(Text, _doubts(report)),
        *([_retargeting(report.retargeting)] if report.retargeting else []),
        _refused(report.refused_parts),
        *(
            Text(f"{stream}: taxels not measured and zero: {_by_reason(reasons)}")
            for stream, reasons in report.refused_taxels.items()
        ),
    )


def _doubts(report: AlignmentReport) -> list[str]:
    """Streams whose times may be wrong, with the reasons."""
    found = []
    for clock in report.clocks:
        whys = {
            "skew": f"its clock is skewed by {_number(clock.skew_ppm, 0)} ppm",
            "residual": "even the earliest samples arrive later than fitted by more than a "
            f"sample period ({_number(clock.residual_rms_ms, 1)} ms RMS of all)",
            "stop": "the device clock stopped or the path delay increased",
        }
        if clock.warnings:
            reasons = " and ".join(whys[warning] for warning in clock.warnings)
            found.append(f"{clock.stream}: unreliable times: {reasons}")
    return found


def _table(title: str, columns: Sequence[str], *, left: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    for name in columns:
        table.add_column(name, justify="left" if name in left else "right")
    return table


def _clocks(report: AlignmentReport) -> Table:
    figures = "samples|in episode|dropped|gaps|residual ms|latency ms|drift ppm|steps"
    columns = ["stream", *figures.split("|"), "dated by"]
    table = _table("streams", columns, left=("stream", "dated by"))
    for clock in report.clocks:
        sigma = "" if clock.latency_sigma_ms is None else f" ± {clock.latency_sigma_ms:.2f}"
        table.add_row(
            clock.stream,
            str(clock.num_samples),
            str(report.streams.get(clock.stream, 0)),
            str(clock.num_dropped),
            f"{report.quality.get(f'{clock.stream}_num_gaps', 0):.0f}",
            _number(clock.residual_rms_ms, 3),
            f"{_number(clock.latency_ms, 2)}{sigma}",
            _number(clock.skew_ppm, 1),
            str(clock.num_steps),
            clock.method or "-",
        )
    return table


def _retargeting(figures: Mapping[str, Mapping[str, float]]) -> Table:
    columns = ("hand", "tip error mm", "95 % below", "steps by status")
    table = _table("retargeting", columns, left=("hand", "steps by status"))
    for side, mine in figures.items():
        shares = {k.removeprefix("share_"): v for k, v in mine.items() if k.startswith("share_")}
        told = ", ".join(f"{name} {share:.2%}" for name, share in shares.items() if share)
        errors_mm = (_number(mine.get(name), 2) for name in ("tip_error_mm", "tip_error_p95_mm"))
        table.add_row(side, *errors_mm, told)
    return table


def _refused(parts: Sequence[RefusedPart]) -> Table | Text:
    if not parts:
        return Text("the whole recording is in the episode")
    table = _table("not in the episode", ("from s", "to s", "for s", "why"), left=("why",))
    longest = sorted(parts, key=lambda part: part.start_s - part.stop_s)[:MAX_LISTED]
    for part in sorted(longest, key=lambda part: part.start_s):
        why = WHY[part.reason] if part.stream is None else f"{part.stream}: {WHY[part.reason]}"
        times_s = part.start_s, part.stop_s, part.stop_s - part.start_s
        table.add_row(*(f"{t_s:.2f}" for t_s in times_s), why)
    if len(parts) > MAX_LISTED:
        table.caption = f"and {len(parts) - MAX_LISTED} shorter ones"
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _by_reason(reasons: Mapping[str, Sequence[int]]) -> str:
    return ", ".join(
        f"{reason} {' '.join(map(str, taxels[:MAX_LISTED]))}{' …' * (len(taxels) > MAX_LISTED)}"
        for reason, taxels in reasons.items()
    )
