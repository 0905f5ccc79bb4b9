"""Commands of `dextouch store` that edit, copy or annotate items: trim, merge, notes, clicks."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic import ValidationError

from dextouch import episodes, schemas
from dextouch.command_line import say
from dextouch.episodes import EpisodeReader, EpisodeStore, Kind, editing
from dextouch.errors import DexTouchError, InvalidInputError
from dextouch.geometry import transform_from_pose
from dextouch.schemas import EditedItem, NewNote, first_problems, json_ready
from services.episode_store.command_context import Context, Outcome, table

EXIT_REFUSED = 1


def trim(context: Context) -> Outcome:
    """Write a span of an item as a new one."""
    options, store = context.options, context.store
    kind, edit = context.kind_of(options.id), _edit_options(context)
    in_seconds = options.from_s is not None or options.to_s is not None
    if options.steps is not None and (in_seconds or kind == "recording"):
        raise InvalidInputError(
            "trim: --steps goes without --from and --to, and with episodes only"
        )
    if options.steps is None and not in_seconds:
        raise InvalidInputError("trim: got no span, expected --from, --to or --steps")
    if kind == "recording":
        result = editing.trim_recording(
            store, options.id, options.from_s, options.to_s, outcome=options.outcome, options=edit
        )
    else:
        steps = options.steps
        if steps is None:
            steps = editing.steps_between(store.open(options.id), options.from_s, options.to_s)
        result = editing.trim_episode(
            store,
            options.id,
            (steps[0], steps[1]),
            outcome=options.outcome,
            exact=options.exact,
            options=edit,
        )
    _say_edit(context, result)
    return json_ready(result), 0


def relabel(context: Context) -> Outcome:
    """Write items with other attributes as new ones."""
    options = context.options
    changes = {
        key: getattr(options, key)
        for key in ("task", "instruction", "operator")
        if getattr(options, key) is not None
    }
    if options.new_id is not None and len(options.ids) > 1:
        raise InvalidInputError("relabel: --as names one item, got several ids")
    edited: list[EditedItem] = []
    refused: dict[str, str] = {}
    for item_id in options.ids:
        try:
            result = editing.relabel_item(
                context.store,
                item_id,
                changes,
                kind=context.kind_of(item_id),
                outcome=options.outcome,
                options=_edit_options(context),
            )
        except DexTouchError as error:
            if len(options.ids) == 1:
                raise
            refused[item_id] = error.message
            say(f"{item_id}  refused  {error.message}")
        else:
            edited.append(result)
            _say_edit(context, result)
    found = {"edited": [json_ready(one) for one in edited], "refused": refused}
    return found, EXIT_REFUSED if refused else 0


def _edit_options(context: Context) -> editing.EditOptions:
    options = context.options
    return editing.EditOptions(new_id=options.new_id, keep=options.keep, dry_run=options.dry_run)


def _say_edit(context: Context, result: EditedItem) -> None:
    counts = ", ".join(f"{name} {count}" for name, count in result.num_samples.items())
    would = "would become" if context.options.dry_run else "is now"
    say(f"{result.source_id}  {would} {result.id}  {result.operation}")
    say(f"  samples: {counts}")
    for message in result.messages:
        say(f"  {message}")
    say(f"  the source {'would be' * context.options.dry_run or 'is'} {result.source_is}")
    if result.sha256 is not None:
        say(f"  content {result.sha256}")


def merge(context: Context) -> Outcome:
    """Copy all items of stores into one."""
    options = context.options
    sources = [EpisodeStore(url).require_folder() for url in options.sources]

    def show(report: editing.MergeReport) -> None:
        renamed = f"as {report.new_id}" if report.new_id not in {"", report.item_id} else ""
        remarks = f"with its {', '.join(report.remarks)}" if report.remarks else ""
        texts = (report.item_id, report.kind, report.action, renamed, remarks, report.reason)
        say("  ".join(text for text in texts if text))

    merge_options = editing.MergeOptions(rename=options.rename, dry_run=options.dry_run)
    reports = editing.merge_stores(sources, context.store, options=merge_options, on_item=show)
    counts = {
        action: sum(one.action == action for one in reports)
        for action in ("copied", "there", "refused")
    }
    what = "would be copied" if options.dry_run else "copied"
    say(f"{counts['copied']} {what}, {counts['there']} there, {counts['refused']} refused")
    return {"items": [asdict(r) for r in reports], **counts}, int(counts["refused"] > 0)


def backup(context: Context) -> Outcome:
    """Bring a backup of the store up to date."""
    options, target = context.options, EpisodeStore(context.options.target)
    accept = options.accept_deletions
    reports = editing.back_up(
        context.store, target, accept_deletions=accept, on_item=_show_backed_up
    )
    return _backup_outcome(reports, f"backup of {context.url} in {target.url}")


def restore_of_backup(context: Context) -> Outcome:
    """Restore the store from a backup, and verify it."""
    source = EpisodeStore(context.options.source)
    reports = editing.restore_backup(source, context.store, on_item=_show_backed_up)
    return _backup_outcome(reports, f"{context.url} restored from {source.url} and verified")


def _show_backed_up(report: editing.BackupReport) -> None:
    if report.action != "there":
        texts = (report.item_id, report.kind, report.action, report.reason)
        say("  ".join(text for text in texts if text))


def _backup_outcome(reports: list[editing.BackupReport], what: str) -> Outcome:
    counts = Counter[str](report.action for report in reports)
    failed = counts["refused"] + counts["damaged"]
    listed = ", ".join(f"{count} {action}" for action, count in sorted(counts.items()))
    say(f"{what}: {listed or 'nothing to copy'}" + " - NOT COMPLETE" * bool(failed))
    return {"items": [asdict(r) for r in reports], **counts}, int(failed > 0)


def note(context: Context) -> Outcome:
    """Add, remove or list notes on time ranges of an item."""
    options, store = context.options, context.store
    kind: Kind = context.kind_of(options.id)
    reader = store.open_item(kind, options.id)
    zero = editing.zero_ns(reader)
    if options.text is not None and options.remove is not None:
        raise InvalidInputError("note: --text and --remove exclude each other")
    if options.text is not None:
        from_s = options.from_s
        if from_s is None:
            raise InvalidInputError("note: got no time, expected --from (and --to)")
        to_s = from_s if options.to_s is None else options.to_s
        times = {"start_ns": zero + round(from_s * 1e9), "stop_ns": zero + round(to_s * 1e9)}
        fields: dict[str, Any] = {**times, "text": options.text, "author": options.author}
        try:
            given = NewNote.model_validate(fields)
        except ValidationError as error:
            raise InvalidInputError(f"note: {first_problems(error)}") from error
        editing.add_note(store, options.id, given, kind=kind)
    elif options.from_s is not None or options.to_s is not None or options.author is not None:
        raise InvalidInputError("note: --from, --to and --author go with --text")
    elif options.remove is not None:
        editing.remove_note(store, options.id, options.remove, kind=kind)
    notes = store.notes(options.id, kind=kind).notes
    for one in notes:
        span = f"{(one.start_ns - zero) / 1e9:.3f} … {(one.stop_ns - zero) / 1e9:.3f} s"
        say(f"{one.number}  {span}  {one.author or '-'}  {one.text}")
    return {"notes": [json_ready(one) for one in notes]}, 0


def clicks(context: Context) -> Outcome:
    """Check the clicks of a file and of the store, and list the places that they and touch give.

    The result is a file of all clicks.
    """
    given = schemas.ObjectClicks.load(context.options.clicks)
    names = sorted({*given.episodes, *context.store.list()})
    found = {name: given.episodes.get(name) or context.store.clicks(name) for name in names}
    rows: list[tuple[str, ...]] = [("episode", "object", "from", "x mm", "y mm", "heading", "± mm")]
    for name, one in found.items():
        reader = context.store.open(name)
        clicked = None
        if one is not None:
            is_lenient = name not in given.episodes
            clicked = episodes.clicked_poses(
                reader.attributes, given, one, may_lack_headings=is_lenient
            )
            rows += _clicked_rows(name, one, clicked)
        rows += _touched_rows(reader, given, clicked)
    for line in table(rows):
        say(line)
    kept = {name: one for name, one in found.items() if one is not None}
    return json_ready(given.model_copy(update={"episodes": kept})), 0


def _clicked_rows(
    name: str, clicked: schemas.EpisodeClicks, found: episodes.ClickedPoses
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
    reader: EpisodeReader, objects: schemas.SceneObjects, clicked: episodes.ClickedPoses | None
) -> Iterator[tuple[str, ...]]:
    """Places that touch alone gives, of objects that neither clicks nor streams place."""
    about = reader.attributes
    listed = objects.tasks.get(about.task, ())
    names = tuple(one.name for one in listed)
    is_touched = about.success and any(one.touch is not None for one in listed)
    if not is_touched or episodes.has_object_poses(reader) or about.object_names not in {(), names}:
        return
    done = np.zeros(len(listed), dtype=np.bool_) if clicked is None else clicked.known
    track = episodes.touched_objects(episodes.EpisodeGrid(reader), objects)
    for index, one in enumerate(listed):
        if one.touch is not None and not done[index]:
            place = ("no clear hold", *[""] * 3)
            if track.known[0, index]:
                place = _place(one, track.poses[0, index], track.sd_m[index])
            yield about.episode_id, one.name, "touch", *place


def _place(one: schemas.SceneObject, pose: np.ndarray, sd_m: float) -> tuple[str, str, str, str]:
    """Place (x, y mm), heading and error (mm) of an object at the first step, as text."""
    axis = one.click.heading
    x, y = transform_from_pose(pose)[:2, "xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
    heading = "symmetric" if one.click.symmetric else f"{np.rad2deg(np.arctan2(y, x)):.0f}°"
    return f"{1e3 * pose[0]:.0f}", f"{1e3 * pose[1]:.0f}", heading, f"{1e3 * sd_m:.1f}"
