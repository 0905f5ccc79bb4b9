"""`dextouch store …`: words and flags in, lists and verdicts of a local store or a service out."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dextouch.episodes import EpisodeReader, EpisodeStore, RecordingReader
from dextouch.errors import CorruptDataError, DexTouchError, StorageError
from dextouch.schemas.episodes import json_ready
from dextouch.serving.logs import configure_logging
from dextouch.serving.settings import load_settings, run
from services.episode_store.app import create_app
from services.episode_store.catalog import Catalog, EpisodeFilter
from services.episode_store.settings import EpisodeStoreSettings

EXIT_DAMAGED = 1
EXIT_REFUSED = 3

Outcome = tuple[dict[str, Any], int]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one word of the store's command line; without a word, serve.

    Returns:
        0, 1 when `verify` found damage, 3 for a refusal.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        if not arguments or arguments[0] == "serve":
            return _serve(arguments[1:])
        if arguments[0].startswith("--") and arguments[0] != "--help":
            return _serve(arguments)
        options = _parser().parse_args(arguments)
        # What the catalog leaves out is told on stderr, beside the list.
        configure_logging(service="episode_store", log_format="auto", level="warning")
        url = options.store or load_settings(EpisodeStoreSettings, []).store_url
        result, status = _WORDS[options.word](EpisodeStore(url), options)
    except DexTouchError as error:
        print(f"dextouch store: {error.message}", file=sys.stderr)
        return EXIT_REFUSED
    if options.json is not None:
        Path(options.json).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return status


def _serve(arguments: list[str]) -> int:
    settings = load_settings(EpisodeStoreSettings, arguments)
    configure_logging(
        service="episode_store", log_format=settings.log_format, level=settings.log_level
    )
    run(create_app(settings), settings)
    return 0


def _list(store: EpisodeStore, options: argparse.Namespace) -> Outcome:
    catalog = Catalog(store)
    if options.kind == "recording":
        recordings = catalog.recordings(limit=sys.maxsize)
        for take in recordings.recordings:
            num_samples = sum(take.num_samples.values())
            print(f"{take.recording_id}  {take.task}  {take.domain}  {num_samples} samples")
        return json_ready(recordings), 0
    wanted = EpisodeFilter(task=options.task, domain=options.domain, origin=options.origin)
    episodes = catalog.episodes(wanted, limit=sys.maxsize)
    outcomes = {True: "success", False: "failure", None: "not judged"}
    for episode in episodes.episodes:
        print(
            f"{episode.episode_id}  {episode.task}  {episode.domain}  {episode.origin}  "
            f"{episode.num_steps} steps  {outcomes[episode.success]}"
        )
    return json_ready(episodes), 0


def _show(store: EpisodeStore, options: argparse.Namespace) -> Outcome:
    reader = _reader(store, options.kind, options.id)
    counts = {name: reader.num_samples(name) for name in reader.streams}
    result = {
        "attributes": json_ready(reader.attributes),
        "num_samples": counts,
        "content_sha256": reader.content_sha256,
    }
    print(json.dumps(result, indent=2))
    return result, 0


def _verify(store: EpisodeStore, options: argparse.Namespace) -> Outcome:
    damaged: dict[str, str] = {}
    ids = options.ids or store.list(kind=options.kind)
    for item_id in ids:
        try:
            found = _reader(store, options.kind, item_id).verify()
        except (CorruptDataError, StorageError) as error:
            damaged[item_id] = error.message
            print(f"{item_id}  DAMAGED  {error.message}")
        else:
            print(f"{item_id}  whole  {found.num_arrays} arrays, {found.num_bytes} bytes")
    return {"verified": len(ids), "damaged": damaged}, EXIT_DAMAGED if damaged else 0


def _delete(store: EpisodeStore, options: argparse.Namespace) -> Outcome:
    for item_id in options.ids:
        store.delete(item_id, kind=options.kind)
        print(f"{item_id}  deleted")
    return {"deleted": options.ids}, 0


def _reader(store: EpisodeStore, kind: str, item_id: str) -> EpisodeReader | RecordingReader:
    return store.recording(item_id) if kind == "recording" else store.open(item_id)


_WORDS: dict[str, Callable[[EpisodeStore, argparse.Namespace], Outcome]] = {
    "list": _list,
    "show": _show,
    "verify": _verify,
    "delete": _delete,
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="dextouch store",
        description="Look into a store, or serve it ('serve --help' lists the settings).",
    )
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--store", metavar="URL", help="local folder or file:///…")
    shared.add_argument("--kind", choices=("episode", "recording"), default="episode")
    shared.add_argument("--json", metavar="PATH", help="write the result there as well")
    words = parser.add_subparsers(dest="word", required=True)
    words.add_parser("serve", help="answer over HTTP", add_help=False)
    listing = words.add_parser("list", parents=[shared], help="what is in the store")
    listing.add_argument("--task")
    listing.add_argument("--domain", choices=("human", "robot"))
    listing.add_argument("--origin", choices=("recorded", "twin", "imagined"))
    show = words.add_parser("show", parents=[shared], help="attributes and sizes of one")
    show.add_argument("id")
    verify = words.add_parser("verify", parents=[shared], help="read everything, compare hashes")
    verify.add_argument("ids", nargs="*", help="all when none is named")
    delete = words.add_parser("delete", parents=[shared], help="remove for good")
    delete.add_argument("ids", nargs="+")
    return parser


if __name__ == "__main__":
    sys.exit(main())
