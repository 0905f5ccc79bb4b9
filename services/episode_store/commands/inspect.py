"""Commands that look into a store: `list`, `show`, `verify`, and `clicks`: where objects stand."""

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from dextouch.episodes import (
    KINDS,
    ClickedPoses,
    EpisodeGrid,
    EpisodeReader,
    GroupFiles,
    Kind,
    LocalGroup,
    RecordingReader,
    clicked_poses,
    has_object_poses,
    shard_path,
    stream_arrays,
    touched_objects,
)
from dextouch.episodes.care import (
    Finding,
    ItemReport,
    Progress,
    inspect_group,
    inspect_stage,
    inspect_upload,
    open_contents,
    unfinished_folders,
)
from dextouch.errors import InvalidInputError, NotFoundError, StorageError
from dextouch.geometry import transform_from_pose
from dextouch.schemas import (
    EpisodeAttributes,
    EpisodeClicks,
    EpisodeSummary,
    RecordingAttributes,
    RecordingSummary,
    SceneObject,
    SceneObjects,
    json_ready,
    load_object_clicks,
)
from services.episode_store.catalog import Catalog
from services.episode_store.commands import EXIT_DAMAGED, Context, Outcome, readable_size, table
from services.episode_store.filters import EpisodeFilter

_OUTCOMES = {True: "success", False: "failure", None: "not judged"}


def list_items(context: Context) -> Outcome:
    """List matching items of the store, or its trash."""
    options = context.options
    if options.trash:
        return _list_trash(context)
    root = context.local_root()
    if root is not None and not root.is_dir():
        raise NotFoundError(f"store {root}: no such folder; name another with --store")
    if options.kind == "recording" and options.origin is not None:
        raise InvalidInputError("list --kind recording: takes no --origin, recordings have none")
    catalog = Catalog(context.store)
    # Recordings have no origin to match.
    kind: Kind | None = "episode" if options.origin is not None else options.kind
    result: dict[str, Any] = {"num_matching": 0, "next_after": None}
    totals = []
    for each in KINDS if kind is None else (kind,):
        found, num_in_all = _list_kind(context, catalog, each)
        result |= found | {"num_matching": result["num_matching"] + found["num_matching"]}
        totals.append(f"{num_in_all} {each}" + "s" * (num_in_all != 1))
    if not result["num_matching"]:
        context.say(f"nothing matches, of {' and '.join(totals)}")
    return result, 0


def _list_kind(context: Context, catalog: Catalog, kind: Kind) -> tuple[dict[str, Any], int]:
    """List matching items of a kind; returns them and the number of all."""
    options = context.options
    wanted = EpisodeFilter(task=options.task, domain=options.domain, origin=options.origin)
    if kind == "episode":
        episodes = catalog.episodes(wanted, limit=sys.maxsize)
        for row in episodes.episodes:
            told = f"{row.origin}  {row.num_steps} steps  {_outcome(row)}"
            context.say(f"{row.episode_id}  episode  {row.task}  {row.domain}  {told}")
        return json_ready(episodes), catalog.episodes(EpisodeFilter(), limit=1).num_matching
    recordings = catalog.recordings(wanted, limit=sys.maxsize)
    for each in recordings.recordings:
        told = f"{sum(each.num_samples.values())} samples  {_outcome(each)}"
        context.say(f"{each.recording_id}  recording  {each.task}  {each.domain}  {told}")
    return json_ready(recordings), catalog.recordings(limit=1).num_matching


def _outcome(
    row: EpisodeSummary | RecordingSummary | EpisodeAttributes | RecordingAttributes,
) -> str:
    return _OUTCOMES[row.success] + "  recovered" * row.recovered


def _list_trash(context: Context) -> Outcome:
    rows = []
    for entry in context.store.trash_list():
        deleted_at = datetime.fromtimestamp(entry.deleted_at_ns / 1e9, UTC)
        date, size = deleted_at.isoformat(timespec="seconds"), readable_size(entry.num_bytes)
        context.say(f"{entry.item_id}  {entry.kind}  deleted {date}  {size}")
        known = {"kind": entry.kind, "id": entry.item_id}
        rows.append(known | {"deleted_at": date, "num_bytes": entry.num_bytes})
    return {"trash": rows}, 0


def show(context: Context) -> Outcome:
    """Attributes of one group and a table of its streams."""
    item_id = context.options.id
    kind = context.kind_of(item_id)
    store = context.store
    reader = store.recording(item_id) if kind == "recording" else store.open(item_id)
    files = store.files(item_id, kind=kind)
    contents = open_contents(files, kind)
    streams = {}
    rows: list[tuple[str, ...]] = [("stream", "Hz", "samples", "gaps", "size", "codec", "encoder")]
    for name, descriptor in reader.streams.items():
        entry, num_gaps = contents.entries[name], _num_gaps(reader, name)
        arrays = stream_arrays(descriptor, kind)
        num_bytes = sum(_shard_bytes(files, a, contents.entries[a].shape) for a in arrays)
        num_samples, rate_hz = reader.num_samples(name), descriptor.nominal_rate_hz
        streams[name] = {
            "rate_hz": rate_hz,
            "num_samples": num_samples,
            "num_gaps": num_gaps,
            "num_bytes": num_bytes,
            "codec": entry.codec,
            "encoder": entry.encoder,
        }
        numbers = (f"{rate_hz:g}", str(num_samples), str(num_gaps), readable_size(num_bytes))
        rows.append((name, *numbers, entry.codec, entry.encoder or ""))
    result = {
        "attributes": json_ready(reader.attributes),
        "num_samples": {name: reader.num_samples(name) for name in reader.streams},
        "streams": streams,
        "content_sha256": reader.content_sha256,
    }
    attributes = reader.attributes
    context.say(f"{kind} {item_id}  {attributes.task}  {attributes.domain}")
    context.say(_outcome(attributes))
    for source in attributes.lineage:
        context.say(f"made from {source.kind} {source.id}")
    for line in table(rows):
        context.say(line)
    context.say(f"content {reader.content_sha256}")
    return result, 0


def _num_gaps(reader: EpisodeReader | RecordingReader, name: str) -> int:
    """Number of gaps: steps between samples above one and a half nominal periods."""
    steps = np.diff(reader.stamps_ns(name))
    return int((steps > 1.5 * reader.streams[name].period_ns()).sum())


def _shard_bytes(files: GroupFiles, array: str, shape: tuple[int, ...]) -> int:
    return files.source(f"{array}/{shard_path(len(shape))}").size() or 0


def verify(context: Context) -> Outcome:
    """Verify items completely and list all damage."""
    items, root = context.items(), context.local_root()
    reports: list[ItemReport] = []
    with _progress_bar(context, items) as progress:
        for kind, item_id in items:
            try:
                files = _files(context, kind, item_id)
                reports.append(inspect_group(files, kind, progress=progress))
            except NotFoundError:
                context.say(f"{item_id}  deleted meanwhile  {kind}")
    if not context.options.ids and root is not None:
        for what, folder in unfinished_folders(root):
            reports.append(_inspect_unfinished(what, folder))
    for report in reports:
        _say_report(context, report)
    damaged = {r.item_id: "; ".join(f.message for f in r.findings) for r in reports if r.damaged}
    result = {
        "verified": sum(report.kind in KINDS for report in reports),
        "damaged": damaged,
        "reports": [asdict(report) for report in reports],
    }
    return result, EXIT_DAMAGED if damaged else 0


def _files(context: Context, kind: Kind, item_id: str) -> GroupFiles:
    root = context.local_root()
    # Not through the store, which ignores groups without a commit record.
    return (
        context.store.files(item_id, kind=kind)
        if root is None
        else LocalGroup(root / f"{kind}s" / item_id)
    )


def _inspect_unfinished(kind: str, folder: Path) -> ItemReport:
    if not folder.is_dir() or folder.is_symlink():
        finding = Finding(f"{kind} {folder.name}: is not a folder; move it away", foreign=True)
        return ItemReport(kind, folder.name, findings=(finding,))
    if kind == "stage":
        return inspect_stage(folder)
    return inspect_upload(folder)


def _say_report(context: Context, report: ItemReport) -> None:
    size = f"{report.num_arrays} arrays, {report.num_bytes} bytes"
    if report.damaged:
        for finding in report.findings:
            context.say(f"{report.item_id}  DAMAGED  {finding.message}")
    elif report.kind in KINDS:
        context.say(f"{report.item_id}  whole  {report.kind}, {size}")
    else:
        state = "being written" if report.busy else "unfinished"
        context.say(f"{report.item_id}  {state}  {report.kind}, {size}")


@contextmanager
def _progress_bar(context: Context, items: list[tuple[Kind, str]]) -> Iterator[Progress]:
    """Progress bar at a terminal, if rich is installed."""
    if not sys.stderr.isatty() or importlib.util.find_spec("rich") is None:
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    total = 0
    for kind, item_id in items:
        try:
            files = _files(context, kind, item_id)
            entries = open_contents(files, kind).entries
            total += sum(_shard_bytes(files, name, e.shape) for name, e in entries.items())
        except (StorageError, NotFoundError):
            continue
    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("verify", total=total)
        yield lambda num_bytes: bar.advance(task, num_bytes)


def clicks(context: Context) -> Outcome:
    """Check the clicks of a file and of the store, and list the places that they and touch give.

    The result is a file of all clicks.
    """
    given = load_object_clicks(context.options.clicks)
    names = sorted({*given.episodes, *context.store.list()})
    found = {name: given.episodes.get(name) or context.store.clicks(name) for name in names}
    rows: list[tuple[str, ...]] = [("episode", "object", "from", "x mm", "y mm", "heading", "± mm")]
    for name, one in found.items():
        reader = context.store.open(name)
        clicked = None
        if one is not None:
            is_lenient = name not in given.episodes
            clicked = clicked_poses(reader.attributes, given, one, may_lack_headings=is_lenient)
            rows += _clicked_rows(name, one, clicked)
        rows += _touched_rows(reader, given, clicked)
    for line in table(rows):
        context.say(line)
    episodes = {name: one for name, one in found.items() if one is not None}
    return json_ready(given.model_copy(update={"episodes": episodes})), 0


def _clicked_rows(
    name: str, clicked: EpisodeClicks, found: ClickedPoses
) -> Iterator[tuple[str, ...]]:
    for index, one in enumerate(found.objects):
        click = clicked.objects.get(one.name)
        if click is None:
            if one.touch is None:
                yield name, one.name, "", "not clicked", *[""] * 3
        elif click.state != "seen":
            yield name, one.name, "clicks", click.state, *[""] * 3
        elif not found.known[index]:
            yield name, one.name, "clicks", "no heading", *[""] * 3
        else:
            place = _place(one, found.poses[index], found.sd_m[index])
            yield name, one.name, "clicks", *place


def _touched_rows(
    reader: EpisodeReader, objects: SceneObjects, clicked: ClickedPoses | None
) -> Iterator[tuple[str, ...]]:
    """Places that touch alone gives, of objects that neither clicks nor streams place."""
    about = reader.attributes
    listed = objects.tasks.get(about.task, ())
    names = tuple(one.name for one in listed)
    is_touched = about.success and any(one.touch is not None for one in listed)
    if not is_touched or has_object_poses(reader) or about.object_names not in {(), names}:
        return
    done = np.zeros(len(listed), dtype=np.bool_) if clicked is None else clicked.known
    track = touched_objects(EpisodeGrid(reader), objects)
    for index, one in enumerate(listed):
        if one.touch is not None and not done[index]:
            place = ("no clear hold", *[""] * 3)
            if track.known[0, index]:
                place = _place(one, track.poses[0, index], track.sd_m[index])
            yield about.episode_id, one.name, "touch", *place


def _place(one: SceneObject, pose: np.ndarray, sd_m: float) -> tuple[str, str, str, str]:
    """Place (x, y mm), heading and error (mm) of an object at the first step, as text."""
    axis = one.click.heading
    x, y = transform_from_pose(pose)[:2, "xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
    heading = "symmetric" if one.click.symmetric else f"{np.rad2deg(np.arctan2(y, x)):.0f}°"
    return f"{1e3 * pose[0]:.0f}", f"{1e3 * pose[1]:.0f}", heading, f"{1e3 * sd_m:.1f}"
