"""Rendering of alignment reports for the terminal: one line each, or a whole page."""

from collections.abc import Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from services.alignment.report import AlignmentReport
from services.alignment.synchronization.refused_parts import RefusedPart

# Taxels for each reason, and refused parts, that a page lists; the report has all.
MAX_LISTED = 12
WHY = {
    "late_start": "began later than the others",
    "early_end": "ended earlier than the others",
    "gap": "no samples",
    "shorter": "a longer stretch without a gap was taken",
}


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
