"""Commands that change a store: `delete`, `deletions`, `restore`, `purge` and `repair`."""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from dextouch.episodes import EpisodeStore, GroupFiles, Kind, TrashKind
from dextouch.episodes.care import (
    LEFT,
    DeletionRecords,
    DeletionRequest,
    RepairReport,
    delete_for_good,
    plan_deletion,
    repair_group,
    repair_uploads,
    reviews_by,
)
from dextouch.errors import InvalidInputError, NotFoundError
from services.episode_store.commands import EXIT_DAMAGED, Context, Outcome, readable_size
from services.episode_store.deletions import deletion_statuses


def delete(context: Context) -> Outcome:
    """Move ids to the trash, delete them permanently, or all data of an operator or recording."""
    options = context.options
    if options.operator is not None or options.recording is not None:
        return _delete_all_of(context)
    if not options.ids:
        raise InvalidInputError(
            "delete: got nothing to delete, expected ids, --operator or --recording"
        )
    if options.derived or options.receipt or options.checkpoints or options.unsent:
        raise InvalidInputError(
            "delete: --derived, --receipt, --checkpoints and --unsent go with --operator or "
            "--recording"
        )
    for item_id, kind in [(item_id, context.kind_of(item_id)) for item_id in options.ids]:
        context.store.delete(item_id, kind=kind, for_good=options.for_good)
        context.say(f"{item_id}  {'deleted permanently' if options.for_good else 'in the trash'}")
    return {"deleted": options.ids, "for_good": options.for_good}, 0


def _delete_all_of(context: Context) -> Outcome:
    options, root = context.options, context.need_local_root()
    if not options.for_good or options.ids:
        raise InvalidInputError(
            "delete: --operator and --recording remove all that stems from them; got "
            f"{'ids as well' if options.ids else 'no --for-good'}, expected --for-good alone"
        )
    # Derived data of an operator is always deleted; that of a recording on request.
    derived = options.derived or options.operator is not None
    request = DeletionRequest(
        operator=options.operator, recording=options.recording, derived=derived
    )
    asked = options.operator or options.recording
    victims = plan_deletion(root, request)
    for victim in victims:
        context.say(f"{victim.place}/{victim.folder}  {victim.reason}")
    gone = {(victim.place, victim.folder) for victim in victims}
    for facts in reviews_by(root, request):
        if (facts.place, facts.folder.name) not in gone:
            context.say(f"{facts.place}/{facts.folder.name}  review: loses its reviewer's name")
    if not options.yes and _answer(f"Type {asked} to delete all of this permanently: ") != asked:
        raise InvalidInputError("delete: not confirmed; nothing was removed")
    path = Path(options.receipt or f"deletion-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.json")
    checkpoints = Path(options.checkpoints) if options.checkpoints else None
    unsent = options.unsent and options.operator is not None
    receipt = delete_for_good(root, request, path, checkpoints=checkpoints, unsent=unsent)
    for reference in receipt.remaining:
        context.say(f"{reference.where}  still names {', '.join(reference.names)}")
    for place in receipt.unreadable:
        context.say(f"{place}  cannot be read; repair or delete it, then repeat")
    for one in receipt.outstanding:
        context.say(_outstanding_line(one.station, one.recordings, has_answered=one.has_answered))
    context.say(
        f"{len(receipt.deleted)} removed, {len(receipt.unnamed_reviews)} reviews without a name, "
        f"{len(receipt.remaining)} references left, "
        f"{len(receipt.unreadable)} unreadable of {receipt.num_files_searched} files searched; "
        f"receipt {path}"
    )
    return receipt.model_dump(mode="json"), 0 if receipt.complete else EXIT_DAMAGED


def _outstanding_line(station: str, recordings: Sequence[str], *, has_answered: bool) -> str:
    held = ", ".join(recordings) or "takes not uploaded yet, if there are any"
    why = "still in its spool" if has_answered else "it removes them when it next asks the store"
    return f"station {station}  outstanding: {held} ({why})"


def deletions(context: Context) -> Outcome:
    """List permanent deletions and what stations have yet to remove."""
    options, records = context.options, DeletionRecords(context.need_local_root())
    if options.readmit is not None:
        if not records.readmit(options.readmit):
            raise NotFoundError(f"deletions: no deleted operator {options.readmit!r}")
        context.say("readmitted: takes of this operator may be uploaded again")
    if options.settle is not None:
        records.confirm(options.settle, revision=records.revision, held={})
        context.say(f"station {options.settle}  nothing outstanding: its spool is gone")
    found = deletion_statuses(records)
    if options.operator is not None or options.recording is not None:
        key = records.key_of(operator=options.operator, recording=options.recording)
        found = [one for one in found if one.key == key]
    for one in found:
        what = "an operator" if one.is_of_operator else "a recording"
        count = sum(len(left.recordings) for left in one.outstanding)
        context.say(
            f"{one.deleted_at:%Y-%m-%d %H:%M:%S} UTC  {what}, {one.num_recordings} recordings, "
            f"{count} outstanding at {len(one.outstanding)} stations"
        )
        for left in one.outstanding:
            line = _outstanding_line(left.station, left.recordings, has_answered=left.has_answered)
            context.say(f"  {line}")
    return {"deletions": [one.model_dump(mode="json") for one in found]}, 0


def _answer(question: str) -> str:
    sys.stderr.write(question)
    sys.stderr.flush()
    return sys.stdin.readline().strip()


def restore(context: Context) -> Outcome:
    """Restore the last deleted item of each id."""
    options = context.options
    for item_id in options.ids:
        kinds = {entry.kind for entry in context.store.trash_list() if entry.item_id == item_id}
        if options.kind is None and len(kinds) > 1:
            raise InvalidInputError(
                f"{item_id!r} is in the trash as {', '.join(sorted(kinds))}; name one with --kind"
            )
        found: TrashKind = next(iter(kinds), "episode")
        kind: TrashKind = options.kind or found
        context.store.restore(item_id, kind=kind)
        context.say(f"{item_id}  restored")
    return {"restored": options.ids}, 0


def purge(context: Context) -> Outcome:
    """Permanently delete old items of the trash."""
    gone = context.store.purge(older_than_s=context.options.older_than)
    for entry in gone:
        context.say(f"{entry.item_id}  {entry.kind}  {readable_size(entry.num_bytes)} freed")
    num_bytes = sum(entry.num_bytes for entry in gone)
    context.say(f"{len(gone)} purged, {readable_size(num_bytes)} freed")
    return {"purged": [entry.item_id for entry in gone], "num_bytes": num_bytes}, 0


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
