"""Command line `dextouch store`: inspect, repair and delete items of a store."""

import gc
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from dextouch.command_line import progress, say, write_result
from dextouch.episodes import (
    KINDS,
    EpisodeStore,
    GroupFiles,
    Kind,
    LocalGroup,
    TrashKind,
    maintenance,
    shard_path,
    stream_arrays,
)
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.schemas import EpisodeAttributes, RecordingAttributes, json_ready
from dextouch.serving import configure_logging
from services.episode_store.catalog import Catalog, ListedRow
from services.episode_store.command_context import Context, Outcome, table
from services.episode_store.filters import EpisodeFilter
from services.episode_store.parser import store_parser

EXIT_DAMAGED = 1
# Commands whose store need not exist.
_MAY_CREATE = ("merge", "restore-backup")
_SIZES = ("bytes", "kB", "MB", "GB", "TB")
_OUTCOMES = {True: "success", False: "failure", None: "not judged"}


def main(argv: Sequence[str]) -> int:
    """Run a command; returns 1 if something is damaged, remains or is not provably deleted."""
    options = store_parser().parse_args(list(argv))
    # Items that the catalog leaves out are reported on stderr.
    configure_logging(service="episode_store", log_format="auto", level="warning")
    url = options.store or _configured_url()
    run = _COMMANDS.get(options.command) or _editing_command(options.command)
    is_new = options.command in _MAY_CREATE
    store = EpisodeStore(url) if is_new else EpisodeStore(url).require_folder()
    result, status = run(Context(store, url, options))
    write_result(options.json, result)
    return status


# Imported where they are needed: `list` should not wait for settings and all that edits items.
def _configured_url() -> str:
    from dextouch.serving import load_settings
    from services.episode_store.settings import EpisodeStoreSettings

    return load_settings(EpisodeStoreSettings, []).store_url


def _editing_command(name: str) -> Callable[[Context], Outcome]:
    from services.episode_store import editing_commands

    of_name = "restore_of_backup" if name == "restore-backup" else name
    command: Callable[[Context], Outcome] = getattr(editing_commands, of_name)
    return command


def readable_size(num_bytes: int) -> str:
    """Format a size with three digits and a unit."""
    size, unit = float(num_bytes), 0
    while size >= 999.5 and unit < len(_SIZES) - 1:
        size, unit = size / 1000, unit + 1
    return f"{num_bytes} bytes" if unit == 0 else f"{size:.3g} {_SIZES[unit]}"


def list_items(context: Context) -> Outcome:
    """List matching items of the store, or its trash."""
    options = context.options
    # Collections among many rows would search all that was imported.
    gc.freeze()
    if options.trash:
        return _list_trash(context)
    if options.kind == "recording" and options.origin is not None:
        raise InvalidInputError("list --kind recording: takes no --origin, recordings have none")
    catalog = Catalog(context.store, progress)
    # Recordings have no origin to match.
    kind: Kind | None = "episode" if options.origin is not None else options.kind
    result: dict[str, Any] = {"num_matching": 0, "next_after": None}
    totals = []
    for each in KINDS if kind is None else (kind,):
        found, num_in_all = _list_kind(context, catalog, each)
        result |= found | {"num_matching": result["num_matching"] + found["num_matching"]}
        totals.append(f"{num_in_all} {each}" + "s" * (num_in_all != 1))
    if not result["num_matching"]:
        say(f"nothing matches, of {' and '.join(totals)}")
    return result, 0


def _list_kind(context: Context, catalog: Catalog, kind: Kind) -> tuple[dict[str, Any], int]:
    """List matching items of a kind; returns them and the number of all."""
    options = context.options
    query = EpisodeFilter(task=options.task, domain=options.domain, origin=options.origin)
    rows = catalog.rows(kind, query)
    for row in rows:
        is_episode = kind == "episode"
        size = f"{row.origin}  {row.size} steps" if is_episode else f"{row.size} samples"
        say(f"{row.id}  {kind}  {row.task}  {row.domain}  {size}  {_outcome(row)}")
    result: dict[str, Any] = {"num_matching": len(rows)}
    if context.options.json is not None:
        read = catalog.episodes if kind == "episode" else catalog.recordings
        result = json_ready(read(query, limit=sys.maxsize))
    return result, catalog.index.num_items(kind)


def _outcome(row: ListedRow | EpisodeAttributes | RecordingAttributes) -> str:
    return _OUTCOMES[row.success] + "  recovered" * row.recovered


def _list_trash(context: Context) -> Outcome:
    rows = []
    for entry in context.store.trash_list():
        deleted_at = datetime.fromtimestamp(entry.deleted_at_ns / 1e9, UTC)
        date, size = deleted_at.isoformat(timespec="seconds"), readable_size(entry.num_bytes)
        say(f"{entry.item_id}  {entry.kind}  deleted {date}  {size}")
        known = {"kind": entry.kind, "id": entry.item_id}
        rows.append(known | {"deleted_at": date, "num_bytes": entry.num_bytes})
    return {"trash": rows}, 0


def show(context: Context) -> Outcome:
    """Attributes of one group and a table of its streams."""
    item_id = context.options.id
    kind = context.kind_of(item_id)
    store = context.store
    reader = store.open_item(kind, item_id)
    files = store.files(item_id, kind=kind)
    contents = maintenance.open_contents(files, kind)
    streams, total_per_hour = {}, 0
    rows: list[tuple[str, ...]] = [
        ("stream", "Hz", "samples", "gaps", "size", "per hour", "codec", "encoder")
    ]
    for name, descriptor in reader.streams.items():
        entry = contents.entries[name]
        codec = entry.attributes.get("encoding", entry.codec)
        # Steps between samples above one and a half nominal periods.
        num_gaps = int((np.diff(reader.stamps_ns(name)) > 1.5 * descriptor.period_ns()).sum())
        arrays = stream_arrays(descriptor, kind, contents.version)
        shards = [f"{one}/{shard_path(len(contents.entries[one].shape))}" for one in arrays]
        num_bytes = sum(files.source(shard).size() or 0 for shard in shards)
        num_samples, rate_hz = reader.num_samples(name), descriptor.nominal_rate_hz
        per_hour = round(3600 * rate_hz * num_bytes / max(1, num_samples))
        total_per_hour += per_hour
        streams[name] = {
            "bytes_per_hour": per_hour,
            "rate_hz": rate_hz,
            "num_samples": num_samples,
            "num_gaps": num_gaps,
            "num_bytes": num_bytes,
            "codec": codec,
            "encoder": entry.encoder,
        }
        numbers = (f"{rate_hz:g}", str(num_samples), str(num_gaps))
        sizes = (readable_size(num_bytes), readable_size(per_hour))
        rows.append((name, *numbers, *sizes, codec, entry.encoder or ""))
    result = {
        "attributes": json_ready(reader.attributes),
        "num_samples": {name: reader.num_samples(name) for name in reader.streams},
        "streams": streams,
        "content_sha256": reader.content_sha256,
    }
    attributes = reader.attributes
    say(f"{kind} {item_id}  {attributes.task}  {attributes.domain}")
    say(_outcome(attributes))
    for source in attributes.lineage:
        say(f"made from {source.kind} {source.id}  {source.operation}".rstrip())
    for line in table(rows):
        say(line)
    say(f"{readable_size(total_per_hour)} per hour")
    say(f"content {reader.content_sha256}")
    return result, 0


def verify(context: Context) -> Outcome:
    """Verify items completely and list all damage."""
    items, root = context.items(), context.root
    reports: list[maintenance.ItemReport] = []
    for kind, item_id in progress(items, "verify", len(items)):
        try:
            # Not through the store, which ignores groups without a commit record.
            files = (
                context.store.files(item_id, kind=kind)
                if root is None
                else LocalGroup(root / f"{kind}s" / item_id)
            )
            reports.append(maintenance.inspect_group(files, kind))
        except NotFoundError:
            say(f"{item_id}  deleted meanwhile  {kind}")
    if not context.options.ids:
        reports += [] if root is None else maintenance.inspect_unfinished(root)
        for problem in Catalog(context.store).index.verify():
            finding = maintenance.Finding(problem, foreign=True)
            reports.append(maintenance.ItemReport("catalog", "catalog", findings=(finding,)))
    for report in reports:
        _say_report(report)
    damaged = {r.item_id: "; ".join(f.message for f in r.findings) for r in reports if r.damaged}
    result = {
        "verified": sum(report.kind in KINDS for report in reports),
        "damaged": damaged,
        "reports": [asdict(report) for report in reports],
    }
    return result, EXIT_DAMAGED if damaged else 0


def _say_report(report: "maintenance.ItemReport") -> None:
    size = f"{report.num_arrays} arrays, {report.num_bytes} bytes"
    if report.damaged:
        for finding in report.findings:
            say(f"{report.item_id}  DAMAGED  {finding.message}")
    elif report.kind in KINDS:
        say(f"{report.item_id}  whole  {report.kind}, {size}")
    else:
        state = "being written" if report.busy else "unfinished"
        say(f"{report.item_id}  {state}  {report.kind}, {size}")


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
    kinds = {item_id: context.kind_of(item_id) for item_id in options.ids}
    for item_id, kind in kinds.items():
        context.store.delete(item_id, kind=kind, for_good=options.for_good)
        say(f"{item_id}  {'deleted permanently' if options.for_good else 'in the trash'}")
    return {"deleted": [*kinds], "for_good": options.for_good}, 0


def _delete_all_of(context: Context) -> Outcome:
    options, root = context.options, context.need_local_root()
    if not options.for_good or options.ids:
        raise InvalidInputError(
            "delete: --operator and --recording remove all that stems from them; got "
            f"{'ids as well' if options.ids else 'no --for-good'}, expected --for-good alone"
        )
    # Derived data of an operator is always deleted; that of a recording on request.
    derived = options.derived or options.operator is not None
    request = maintenance.DeletionRequest(
        operator=options.operator, recording=options.recording, derived=derived
    )
    name = options.operator or options.recording
    victims = maintenance.plan_deletion(root, request)
    for victim in victims:
        say(f"{victim.place}/{victim.folder}  {victim.reason}")
    gone = {(victim.place, victim.folder) for victim in victims}
    for facts in maintenance.reviews_by(root, request):
        if (facts.place, facts.folder.name) not in gone:
            say(f"{facts.place}/{facts.folder.name}  review or notes: lose their author's name")
    if not options.yes and _answer(f"Type {name} to delete all of this permanently: ") != name:
        raise InvalidInputError("delete: not confirmed; nothing was removed")
    path = options.receipt or Path(f"deletion-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.json")
    unsent = options.unsent and options.operator is not None
    receipt = maintenance.delete_for_good(
        root, request, path, checkpoints=options.checkpoints, unsent=unsent
    )
    for reference in receipt.remaining:
        say(f"{reference.where}  still names {', '.join(reference.names)}")
    for place in receipt.unreadable:
        say(f"{place}  cannot be read; repair or delete it, then repeat")
    for one in receipt.outstanding:
        say(_outstanding_line(one.station, one.recordings, has_answered=one.has_answered))
    say(
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
    from services.episode_store.deletions import deletion_statuses

    options, records = context.options, maintenance.DeletionRecords(context.need_local_root())
    if options.readmit is not None:
        if not records.readmit(options.readmit):
            raise NotFoundError(f"deletions: no deleted operator {options.readmit!r}")
        say("readmitted: takes of this operator may be uploaded again")
    if options.settle is not None:
        records.confirm(options.settle, revision=records.revision, held={})
        say(f"station {options.settle}  nothing outstanding: its spool is gone")
    found = deletion_statuses(records)
    if options.operator is not None or options.recording is not None:
        key = records.key_of(operator=options.operator, recording=options.recording)
        found = [one for one in found if one.key == key]
    for one in found:
        what = "an operator" if one.is_of_operator else "a recording"
        count = sum(len(left.recordings) for left in one.outstanding)
        say(
            f"{one.deleted_at:%Y-%m-%d %H:%M:%S} UTC  {what}, {one.num_recordings} recordings, "
            f"{count} outstanding at {len(one.outstanding)} stations"
        )
        for left in one.outstanding:
            line = _outstanding_line(left.station, left.recordings, has_answered=left.has_answered)
            say(f"  {line}")
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
        say(f"{item_id}  restored")
    return {"restored": options.ids}, 0


def purge(context: Context) -> Outcome:
    """Permanently delete old items of the trash."""
    gone = context.store.purge(older_than_s=context.options.older_than)
    for entry in gone:
        say(f"{entry.item_id}  {entry.kind}  {readable_size(entry.num_bytes)} freed")
    num_bytes = sum(entry.num_bytes for entry in gone)
    say(f"{len(gone)} purged, {readable_size(num_bytes)} freed")
    return {"purged": [entry.item_id for entry in gone], "num_bytes": num_bytes}, 0


def repair(context: Context) -> Outcome:
    """Repair damaged items from a copy, and salvage the rest."""
    root, options = context.need_local_root(), context.options
    copies = EpisodeStore(options.source).require_folder() if options.source else None
    reports = [] if options.ids else maintenance.repair_uploads(root)
    for kind, name in context.items():
        reports.append(maintenance.repair_group(root, kind, name, copy=_copy(copies, kind, name)))
    for report in reports:
        say(f"{report.item_id}  {report.action}" + f"  as {report.new_id}" * bool(report.new_id))
        for name, count in report.lost.items():
            say(f"  {name}: {count} samples lost")
        for text in report.notes:
            say(f"  {text}")
    left = any(report.action == maintenance.LEFT for report in reports)
    return {"reports": [asdict(r) for r in reports]}, EXIT_DAMAGED if left else 0


def _copy(copies: EpisodeStore | None, kind: Kind, item_id: str) -> GroupFiles | None:
    if copies is None:
        return None
    try:
        return copies.files(item_id, kind=kind)
    except NotFoundError:
        return None


_COMMANDS: dict[str, Callable[[Context], Outcome]] = {
    "list": list_items,
    "show": show,
    "verify": verify,
    "delete": delete,
    "deletions": deletions,
    "restore": restore,
    "purge": purge,
    "repair": repair,
}
