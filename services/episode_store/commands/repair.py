"""Command `repair`."""

from dataclasses import asdict

from dextouch.episodes import EpisodeStore, GroupFiles, Kind
from dextouch.episodes.care import LEFT, RepairReport, repair_group, repair_uploads
from dextouch.errors import NotFoundError
from services.episode_store.commands.context import EXIT_DAMAGED, Context, Outcome


def repair(context: Context) -> Outcome:
    """Repair damaged items from a copy, and salvage the rest."""
    root, options = context.need_local_root(), context.options
    copies = EpisodeStore(options.source) if options.source else None
    reports = [] if options.ids else repair_uploads(root)
    for kind, item_id in context.items():
        reports.append(repair_group(root, kind, item_id, copy=_copy(copies, kind, item_id)))
    for report in reports:
        _say_report(context, report)
    left = any(report.action == LEFT for report in reports)
    return {"reports": [asdict(r) for r in reports]}, EXIT_DAMAGED if left else 0


def _copy(copies: EpisodeStore | None, kind: Kind, item_id: str) -> GroupFiles | None:
    if copies is None:
        return None
    try:
        return copies.files(item_id, kind=kind)
    except NotFoundError:
        return None


def _say_report(context: Context, report: RepairReport) -> None:
    context.say(
        f"{report.item_id}  {report.action}" + f"  as {report.new_id}" * bool(report.new_id)
    )
    for name, count in report.lost.items():
        context.say(f"  {name}: {count} samples lost")
    for note in report.notes:
        context.say(f"  {note}")
