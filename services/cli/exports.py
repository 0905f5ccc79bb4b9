"""Commands `dextouch export` and `dextouch import` for formats of other tools."""

import argparse
import math
import shutil
import sys
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from dextouch.command_line import CommandParser, add_json, progress, write_result
from dextouch.data_folder import default_store
from dextouch.episodes import EpisodeReader, EpisodeStore, RecordingReader, is_rejected
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.schemas import EpisodeAttributes, RecordingAttributes
from dextouch.system_files import is_system_file

Reader = EpisodeReader | RecordingReader
Report = dict[str, object]
# By id and camera.
DamagedImages = dict[str, dict[str, list[int]]]
# Of damaged images, in a message; the JSON report has all.
MAX_NAMED = 20

_EXPORT_HELP = """\
formats:
  lerobot  a LeRobotDataset v3.0 folder: episodes on a frame grid, video, parquet
  umi      one zip with a Zarr v2 replay buffer: episodes on the model grid
           (cannot be imported)
  mcap     one file per episode or recording, every sample; opens in Foxglove
  rrd      one file per episode or recording, every sample; opens in Rerun (cannot be imported)

examples:
  dextouch export --format mcap stand-bottle-0003 --to take.mcap
  dextouch export --format mcap --kind recording --operator p17 --to takes/
  dextouch export --format lerobot --task stand_bottle --to data/lerobot
  dextouch export --format umi --domain robot --to robot.zarr.zip
  dextouch export --format rrd stand-bottle-0003 --to take.rrd
"""
_IMPORT_HELP = """\
examples:
  dextouch import --format mcap take.mcap
  dextouch import --format mcap takes/
  dextouch import --format lerobot data/lerobot --id-prefix theirs-

What each format keeps and loses: docs/bridges.md
"""


# Formats with one file per episode or recording, and those with all episodes together.
_SINGLE, _JOINT = ("mcap", "rrd"), ("umi", "lerobot")


def _export_one(reader: Reader, path: Path, options: argparse.Namespace) -> int:
    if options.format == "rrd":
        from dextouch.bridges.rerun import export_rrd

        return export_rrd(reader, path, overwrite=options.force)
    from dextouch.bridges.mcap import export_mcap

    return export_mcap(reader, path, overwrite=options.force, jpeg_quality=options.jpeg_quality)


def _export_all(readers: Iterator[EpisodeReader], options: argparse.Namespace) -> int:
    if options.format == "umi":
        from dextouch.bridges.umi import export_umi

        return export_umi(readers, options.to, overwrite=options.force)
    from dextouch.bridges.lerobot import ExportOptions, export_lerobot

    with _replaced(options.to, force=options.force):
        chosen = ExportOptions(fps=options.fps)
        return export_lerobot(readers, options.to, repo_id=options.repo_id, options=chosen)


@contextmanager
def _replaced(folder: Path, *, force: bool) -> Iterator[None]:
    """Replace an existing data set, restoring it if the new one fails."""
    if not folder.exists():
        yield
        return
    if not force:
        raise ConflictError(f"{folder}: exists already; choose another folder or add --force")
    if not (folder / "meta" / "info.json").is_file():
        raise ConflictError(f"{folder}: is not a LeRobot data set, so --force does not remove it")
    aside = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.old")
    folder.rename(aside)
    with ExitStack() as undo:
        undo.callback(aside.rename, folder)
        yield
        undo.pop_all()
    shutil.rmtree(aside)


def _ids(store: EpisodeStore, options: argparse.Namespace) -> list[str]:
    """The given ids, or those that match the filters and were not rejected in review."""
    given = ((key, getattr(options, key)) for key in ("task", "domain", "operator"))
    wanted = {key: value for key, value in given if value is not None}
    if options.ids and wanted:
        raise InvalidInputError(f"got ids and filters {sorted(wanted)}; expected one of the two")
    if len(set(options.ids)) != len(options.ids):
        raise InvalidInputError("got an id twice; expected every id once")
    if options.ids:
        return list(options.ids)
    found, num_rejected = [], 0
    for item_id in store.list(kind=options.kind):
        attributes = _open(store, options.kind, item_id).attributes
        if any(getattr(attributes, key) != value for key, value in wanted.items()):
            continue
        if not options.with_rejected and _is_rejected(store, attributes):
            num_rejected += 1
        else:
            found.append(item_id)
    left_out = f"{num_rejected} rejected in review left out; --with-rejected exports them"
    if not found:
        raise NotFoundError(
            f"{options.store}: no {options.kind} matches {wanted or 'anything'}"
            f"{f' ({left_out})' if num_rejected else ''}; `dextouch store list` shows its contents"
        )
    if num_rejected:
        print(left_out, file=sys.stderr)
    return found


def _is_rejected(store: EpisodeStore, about: EpisodeAttributes | RecordingAttributes) -> bool:
    if isinstance(about, EpisodeAttributes):
        return is_rejected(store, about)
    review = store.review(about.recording_id, kind="recording")
    return review is not None and review.verdict == "rejected"


def _note_damaged(reader: Reader, damaged: DamagedImages) -> None:
    """Note the images that cannot be decoded, and say how many and which: no export has them."""
    for name in reader.streams:
        lost = reader.damaged_images(name).tolist()
        if lost:
            damaged.setdefault(reader.item_id, {})[name] = lost
            shown = ", ".join(map(str, lost[:MAX_NAMED])) + ", …" * (len(lost) > MAX_NAMED)
            print(
                f"{reader.item_id}: {name}: {len(lost)} of {reader.num_samples(name)} images "
                "cannot be decoded and are left out; where a data set needs one for a step, the "
                f"nearest other stands (images {shown})",
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


def _open(store: EpisodeStore, kind: str, item_id: str) -> Reader:
    return store.recording(item_id) if kind == "recording" else store.open(item_id)


def _export(options: argparse.Namespace) -> Report:
    store, to, form = EpisodeStore(options.store), options.to, options.format
    if form in _JOINT and options.kind == "recording":
        raise InvalidInputError(
            f"format {form!r} holds episodes only; export recordings as mcap or rrd"
        )
    ids = _ids(store, options)
    report: Report = {"format": form, "kind": options.kind, "ids": ids}
    shown = progress(ids, f"export {form}", len(ids))
    damaged: DamagedImages = {}
    report["damaged_images"] = damaged
    if form in _JOINT:
        left_out: list[str] = []
        num_steps = _export_all(_episodes(store, shown, damaged, left_out), options)
        print(f"{to}  {len(ids) - len(left_out)} episodes  {num_steps} steps")
        return report | {"path": str(to), "num_steps": num_steps, "left_out": left_out}
    # One file for one id, a folder of files otherwise.
    paths = {item_id: to / f"{item_id}.{form}" for item_id in ids}
    if to.suffix == f".{form}":
        if len(ids) > 1:
            raise InvalidInputError(f"--to {to}: got one file for {len(ids)} ids; name a folder")
        paths = {ids[0]: to}
    taken = [path for path in paths.values() if path.exists()]
    if taken and not options.force:
        raise ConflictError(f"{taken[0]}: exists already; choose another path or add --force")
    files: list[dict[str, object]] = []
    for item_id in shown:
        path = paths[item_id]
        reader = _open(store, options.kind, item_id)
        _note_damaged(reader, damaged)
        count = _export_one(reader, path, options)
        files.append({"id": item_id, "path": str(path), "num_messages": count})
        print(f"{path}  {count} messages")
    return report | {"files": files}


def _import(options: argparse.Namespace) -> Report:
    store, path = EpisodeStore(options.store), options.path
    if not path.exists():
        raise NotFoundError(f"{path}: no such file or folder")
    if options.format == "mcap":
        from dextouch.bridges.mcap import import_mcap

        found = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        files = [file for file in found if file == path or not is_system_file(file.name)]
        if not files:
            raise NotFoundError(f"{path}: holds no .mcap file")
        names = progress(files, "import mcap", len(files))
        ids = [import_mcap(file, store) for file in names]
    else:
        from dextouch.bridges.lerobot import ImportOptions, import_lerobot

        chosen = ImportOptions(id_prefix=options.id_prefix, images=options.images)
        ids = import_lerobot(path, store, options=chosen)
    for item_id in ids:
        print(item_id)
    return {"format": options.format, "store": options.store, "ids": ids}


def export_main(argv: Sequence[str]) -> int:
    """Run `dextouch export`."""
    parser = _parser("export", "Write episodes or recordings for other tools.", _EXPORT_HELP)
    add = parser.add_argument
    forms = sorted([*_SINGLE, *_JOINT])
    add("ids", nargs="*", metavar="ID", help="default: all that match the filters")
    add("--format", required=True, choices=forms, help="output format")
    to = "file; mcap and rrd: or a folder"
    add("--to", required=True, type=Path, metavar="PATH", help=to)
    kinds = ("episode", "recording")
    add("--kind", choices=kinds, default="episode", help="kind of the ids (%(default)s)")
    add("--task", metavar="TASK", help="only episodes of this task")
    add("--domain", choices=("human", "robot"), help="only episodes of this domain")
    add("--operator", metavar="P", help="only items of this operator")
    rejected = "also items that were rejected in review; ids that are given always are"
    add("--with-rejected", action="store_true", help=rejected)
    add("--force", action="store_true", help="replace existing files")
    quality = "mcap: encode rgb8 images as JPEG (default: lossless)"
    add("--jpeg-quality", type=int, metavar="1…100", help=quality)
    rate = "lerobot: frames per second (default: model rate)"
    add("--fps", type=_whole_fps, metavar="N", help=rate)
    name = "lerobot: name of the data set (%(default)s)"
    add("--repo-id", default="dextouch/export", metavar="USER/NAME", help=name)
    options = parser.parse_args(list(argv))
    write_result(options.json, _export(options))
    return 0


def _whole_fps(text: str) -> int:
    """Frames per second of a LeRobot dataset, whose format counts whole ones."""
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = math.nan
    if not math.isfinite(rate_hz) or rate_hz != round(rate_hz):
        near = f"; {round(rate_hz)} is the nearest" if math.isfinite(rate_hz) else ""
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected a whole number, since LeRobot counts whole frames{near}"
        )
    return round(rate_hz)


def import_main(argv: Sequence[str]) -> int:
    """Run `dextouch import`."""
    parser = _parser("import", "Read files of other tools into a store.", _IMPORT_HELP)
    add = parser.add_argument
    add("path", type=Path, metavar="PATH", help="file or folder to read")
    add("--format", required=True, choices=("lerobot", "mcap"), help="input format")
    add("--id-prefix", default="", metavar="TEXT", help="lerobot: prefix of every id")
    images = "lerobot: unit of stored images (%(default)s)"
    add("--images", choices=("h264", "jpeg", "rgb8"), default="h264", help=images)
    options = parser.parse_args(list(argv))
    write_result(options.json, _import(options))
    return 0


def _parser(word: str, does: str, more: str) -> argparse.ArgumentParser:
    parser = CommandParser(prog=f"dextouch {word}", description=does, epilog=more)
    store = "the store (%(default)s)"
    parser.add_argument("--store", metavar="URL", default=default_store(), help=store)
    add_json(parser)
    return parser
