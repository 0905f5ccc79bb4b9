"""Commands `dextouch export` and `dextouch import` for formats of other tools."""

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from dextouch.bridges.formats import FORMATS
from dextouch.command_line import progress, write_result
from dextouch.episodes import (
    Attributes,
    EpisodeReader,
    EpisodeStore,
    Kind,
    RecordingReader,
    is_rejected,
)
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    NotFoundError,
)
from dextouch.schemas import first_problems
from services.pipelines.parsers import (
    EXPORT_FILTERS,
    check_format_options,
    export_parser,
    import_parser,
)

if TYPE_CHECKING:
    from dextouch.bridges.import_recording import ImportReport

Reader = EpisodeReader | RecordingReader
Report = dict[str, Any]
# By id and camera.
DamagedImages = dict[str, dict[str, list[int]]]
# Exit status if some of several files were refused, as of a command that is.
_SOME_FAILED = 3
# Of damaged images, in a message; the JSON report has all.
MAX_NAMED = 20


def _export_rrd(reader: Reader, path: Path, options: argparse.Namespace) -> int:
    from dextouch.bridges.rerun import export_rrd

    return export_rrd(reader, path, overwrite=options.force)


def _export_mcap(reader: Reader, path: Path, options: argparse.Namespace) -> int:
    from dextouch.bridges.mcap import export_mcap

    return export_mcap(
        reader,
        path,
        overwrite=options.force,
        jpeg_quality=options.jpeg_quality,
        touch_images=options.touch_images,
    )


def _export_umi(readers: Iterator[EpisodeReader], options: argparse.Namespace) -> Report:
    from dextouch.bridges.umi import export_umi

    return {"num_steps": export_umi(readers, options.to, overwrite=options.force)}


def _export_lerobot(readers: Iterator[EpisodeReader], options: argparse.Namespace) -> Report:
    from dextouch.bridges.lerobot import ExportOptions, export_dataset

    chosen = ExportOptions(
        fps=options.fps,
        cameras=options.cameras,
        touch_samples=options.touch_samples,
        license_name=options.license,
        existing="append" if options.append else "replace" if options.force else "refuse",
    )
    done = export_dataset(readers, options.to, repo_id=options.repo_id, options=chosen)
    if done.present:
        print(f"{len(done.present)} episodes were in the data set already", file=sys.stderr)
    if done.num_touch_left_out:
        print(
            f"{done.num_touch_left_out} touch samples are left out: more of them lie between two "
            "frames than the data set has room for",
            file=sys.stderr,
        )
    if done.cameras_left_out:
        print(
            f"cameras without colours are left out: {', '.join(done.cameras_left_out)}; an export "
            "as MCAP has them",
            file=sys.stderr,
        )
    return {
        "num_steps": done.num_frames,
        "cameras_left_out": list(done.cameras_left_out),
        "present": list(done.present),
        "num_touch_left_out": done.num_touch_left_out,
    }


# Write one item and return the number of messages; write all episodes, and the report about them.
_EXPORT_ONE = {"mcap": _export_mcap, "rrd": _export_rrd}
_EXPORT_ALL = {"umi": _export_umi, "lerobot": _export_lerobot}


def _ids(store: EpisodeStore, options: argparse.Namespace) -> list[str]:
    """The given ids, or those that match the filters and were not rejected in review."""
    given = vars(options)
    criteria = {key: given[key] for key in EXPORT_FILTERS if given[key] is not None}
    if options.ids and criteria:
        raise InvalidInputError(f"got ids and filters {sorted(criteria)}; expected one of the two")
    if len(set(options.ids)) != len(options.ids):
        raise InvalidInputError("got an id twice; expected every id once")
    if options.ids:
        return list(options.ids)
    matching = _matching(store, options.kind, criteria)
    found = matching
    if not options.with_rejected and options.review is None:
        about = ((name, store.open_item(options.kind, name).attributes) for name in matching)
        found = [name for name, attributes in about if not is_rejected(store, attributes)]
    num_rejected = len(matching) - len(found)
    left_out = f"{num_rejected} rejected in review left out; --with-rejected exports them"
    if not found:
        named = {key: str(value) for key, value in criteria.items()}
        raise NotFoundError(
            f"{options.store}: no {options.kind} matches {named or 'anything'}"
            f"{f' ({left_out})' if num_rejected else ''}; `dextouch store list` shows its contents"
        )
    if num_rejected:
        print(left_out, file=sys.stderr)
    return found


def _matching(store: EpisodeStore, kind: Kind, criteria: Mapping[str, object]) -> list[str]:
    from services.episode_store.catalog import Catalog
    from services.episode_store.filters import ItemFilter

    stored, catalog = store.list(kind=kind), Catalog(store)
    every = ItemFilter.model_validate({"kind": kind})
    known = {item.id for item in catalog.items(every, limit=len(stored) + 1).items}
    for item_id in sorted({*stored} - known):
        # The catalog omits damaged items; this tells why.
        store.open_item(kind, item_id)
    named = {"after": "created_after", "before": "created_before"}
    try:
        query = ItemFilter.model_validate(
            {"kind": kind} | {named.get(key, key): value for key, value in criteria.items()}
        )
    except ValidationError as error:
        raise InvalidInputError(f"filters: {first_problems(error)}") from error
    return [item.id for item in catalog.items(query, limit=len(stored) + 1).items]


def _note_damaged(reader: Reader, damaged: DamagedImages) -> None:
    """Note the images that cannot be decoded, and say how many and which: no export has them."""
    for name in reader.streams:
        lost = reader.damaged_images(name).tolist()
        if lost:
            damaged.setdefault(reader.item_id, {})[name] = lost
            steps = ", ".join(map(str, lost[:MAX_NAMED])) + ", …" * (len(lost) > MAX_NAMED)
            print(
                f"{reader.item_id}: {name}: {len(lost)} of {reader.num_samples(name)} images "
                "cannot be decoded and are left out; where a data set needs one for a step, the "
                f"nearest other stands (images {steps})",
                file=sys.stderr,
            )


def _episodes(
    store: EpisodeStore, ids: Iterable[str], damaged: DamagedImages, left_out: list[str]
) -> Iterator[EpisodeReader]:
    """Episodes of one data set, without those of which a camera has no image that is whole."""
    for item_id in ids:
        episode = store.open(item_id)
        _note_damaged(episode, damaged)
        lost = damaged.get(item_id, {})
        blind = [name for name, images in lost.items() if len(images) == episode.num_samples(name)]
        if blind:
            left_out.append(item_id)
            print(f"{item_id}: left out: no image of {', '.join(blind)} is whole", file=sys.stderr)
        else:
            yield episode


def _export(options: argparse.Namespace) -> Report:
    store, to, form = EpisodeStore(options.store), options.to, options.format
    check_format_options(export_parser(), options, form)
    if FORMATS[form].is_joint and options.kind == "recording":
        raise InvalidInputError(
            f"format {form!r} holds episodes only; export recordings as mcap or rrd"
        )
    ids = _ids(store, options)
    damaged: DamagedImages = {}
    report: Report = {"format": form, "kind": options.kind, "ids": ids, "damaged_images": damaged}
    tracked = progress(ids, f"export {form}", len(ids))
    if FORMATS[form].is_joint:
        left_out: list[str] = []
        done = _EXPORT_ALL[form](_episodes(store, tracked, damaged, left_out), options)
        num_new = len(ids) - len(left_out) - len(done.get("present", []))
        print(f"{to}  {num_new} episodes  {done['num_steps']} steps")
        return report | done | {"path": str(to), "left_out": left_out}
    paths = _paths(ids, options)
    files: list[dict[str, object]] = []
    exported: list[Attributes] = []
    for item_id in tracked:
        reader = store.open_item(options.kind, item_id)
        _note_damaged(reader, damaged)
        count = _EXPORT_ONE[form](reader, paths[item_id], options)
        files.append({"id": item_id, "path": str(paths[item_id]), "num_messages": count})
        print(f"{paths[item_id]}  {count} messages")
        exported.append(reader.attributes)
    return report | {"files": files} | (_end_mcap(exported, options) if form == "mcap" else {})


def _paths(ids: Sequence[str], options: argparse.Namespace) -> dict[str, Path]:
    to, form = options.to, options.format
    paths = {item_id: to / f"{item_id}.{form}" for item_id in ids}
    if to.suffix == f".{form}":
        if len(ids) > 1:
            raise InvalidInputError(f"--to {to}: got one file for {len(ids)} ids; name a folder")
        paths = {ids[0]: to}
    layout = _layout_path(options) if form == "mcap" else None
    if layout in paths.values():
        raise InvalidInputError(f"--layout {layout}: is one of the exported files; name another")
    taken = [path for path in (*paths.values(), layout) if path and path.exists()]
    if taken and not options.force:
        raise ConflictError(f"{taken[0]}: exists already; choose another path or add --force")
    return paths


def _end_mcap(exported: Sequence[Attributes], options: argparse.Namespace) -> Report:
    from dextouch.bridges.foxglove import write_layout
    from dextouch.bridges.mcap import has_wall_times

    num_undated = sum(not has_wall_times(about) for about in exported)
    if num_undated:
        print(
            f"{num_undated} of {len(exported)} do not know when they were recorded (created_at, or "
            "started_at and started_t_host_ns); their times do not begin at a date but near 1970",
            file=sys.stderr,
        )
    layout = _layout_path(options)
    if layout is None:
        return {}
    write_layout(layout, [stream for about in exported for stream in about.streams])
    print(f"{layout}  layout for Foxglove: open it with Import from file")
    return {"layout": str(layout)}


def _layout_path(options: argparse.Namespace) -> Path | None:
    """Where a layout for Foxglove goes: the path that was given, or into the folder of files."""
    if options.layout is not None or options.to.suffix == ".mcap":
        given: Path | None = options.layout
        return given
    from dextouch.bridges.foxglove import LAYOUT_FILE

    return Path(options.to / LAYOUT_FILE)


def _import(options: argparse.Namespace) -> Report:
    store, path = EpisodeStore(options.store), options.path
    if not path.exists():
        raise NotFoundError(f"{path}: no such file or folder")
    from dextouch.bridges.import_recording import files_of, find_format

    form = options.format or find_format(path)
    check_format_options(import_parser(), options, form)
    about = {"format": form, "store": options.store}
    if form == "lerobot":
        from dextouch.bridges.lerobot import ImportOptions, import_dataset

        chosen = ImportOptions(
            mapping=options.map,
            id_prefix=options.id_prefix,
            images=options.images,
            K_head=options.k_head,
            domain=options.domain or "robot",
            task=options.task,
            instruction=options.instruction,
            fps=options.fps,
        )
        result = import_dataset(path, store, options=chosen)
        print(*result.lines(), sep="\n")
        for name, reason in result.failed.items():
            print(f"{path}: {name}: not imported: {reason}", file=sys.stderr)
        return about | result.as_json()
    files = files_of(path, form) if path.is_dir() else [path]
    if not files:
        raise NotFoundError(f"{path}: holds no .{form} file")
    import_file = _import_apart if form == "rrd" else _import_file
    reports, failed = [], {}
    for file in progress(files, f"import {form}", len(files)):
        try:
            report = import_file(file, store, form, options)
        except DexTouchError as error:
            if len(files) == 1:
                raise
            failed[str(file)] = error.message
            print(f"{file}: not imported: {error.message}", file=sys.stderr)
            continue
        reports.append(report)
        print(*(report.lines() if report.imported else [report.recording_id]), sep="\n")
    ids = [report.recording_id for report in reports]
    return about | {"ids": ids, "reports": [r.as_json() for r in reports], "failed": failed}


def _import_file(
    path: Path, store: EpisodeStore, form: str, options: argparse.Namespace
) -> "ImportReport":
    from dextouch.bridges.import_recording import ImportAttributes
    from dextouch.tactile.layout import read_layout

    about = ImportAttributes(
        mapping=options.map,
        id_prefix=options.id_prefix,
        task=options.task or "imported",
        instruction=options.instruction,
        domain=options.domain or "human",
        images=options.images or "h264",
        layout=None if options.layout is None else read_layout(options.layout),
    )
    if form == "rrd":
        from dextouch.bridges.import_rerun import import_rrd

        return import_rrd(path, store, about, timeline=options.timeline)
    from dextouch.bridges.import_mcap import import_any_mcap

    return import_any_mcap(path, store, about)


def _import_apart(
    path: Path, store: EpisodeStore, form: str, options: argparse.Namespace
) -> "ImportReport":
    """`_import_file` in a process of its own, since Rerun's reader aborts it at some damage."""
    from concurrent.futures.process import BrokenProcessPool

    from dextouch.jobs import worker_pool

    with worker_pool(1) as pool:
        try:
            return pool.submit(_import_file, path, store, form, options).result()
        except BrokenProcessPool as error:
            raise CorruptDataError(
                f"{path}: rerun-sdk ended its process while reading: the file is damaged, or "
                "memory ran out; copy it again, or see what `rerun rrd verify` says"
            ) from error


def export_main(argv: Sequence[str]) -> int:
    """Run `dextouch export`."""
    options = export_parser().parse_args(list(argv))
    write_result(options.json, _export(options))
    return 0


def import_main(argv: Sequence[str]) -> int:
    """Run `dextouch import`."""
    options = import_parser().parse_args(list(argv))
    report = _import(options)
    write_result(options.json, report)
    return _SOME_FAILED if report.get("failed") else 0
