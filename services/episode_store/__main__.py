"""`dextouch store …`: words and flags in, lists and verdicts of a local store or a service out."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from dextouch.episodes import EpisodeStore
from dextouch.episodes.trash import TRASH_KINDS
from dextouch.errors import DexTouchError
from dextouch.serving.logs import configure_logging
from dextouch.serving.settings import load_settings, run
from services.episode_store.app import create_app
from services.episode_store.commands import delete, inspect, repair
from services.episode_store.commands.context import Context, Outcome, seconds_of
from services.episode_store.settings import EpisodeStoreSettings

EXIT_REFUSED = 3


def main(argv: Sequence[str] | None = None) -> int:
    """Run one word of the store's command line; without a word, serve.

    Returns:
        0, 1 when something is damaged, left or not provably gone, 3 for a refusal.
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
        # With the result itself on stdout, what is said goes beside it.
        out = sys.stderr if options.json == "-" else sys.stdout
        context = Context(EpisodeStore(url), url, options, lambda line: print(line, file=out))
        result, status = _COMMANDS[options.command](context)
    except DexTouchError as error:
        print(f"dextouch store: {error.message}", file=sys.stderr)
        return EXIT_REFUSED
    if options.json == "-":
        print(json.dumps(result, indent=2))
    elif options.json is not None:
        Path(options.json).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return status


def _serve(arguments: list[str]) -> int:
    settings = load_settings(EpisodeStoreSettings, arguments)
    configure_logging(
        service="episode_store", log_format=settings.log_format, level=settings.log_level
    )
    run(create_app(settings), settings)
    return 0


_COMMANDS: dict[str, Callable[[Context], Outcome]] = {
    "list": inspect.list_items,
    "show": inspect.show,
    "verify": inspect.verify,
    "delete": delete.delete,
    "restore": delete.restore,
    "purge": delete.purge,
    "repair": repair.repair,
    "migrate": repair.migrate,
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="dextouch store",
        description="Look into a store, mend it, or serve it ('serve --help' lists the settings).",
    )
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--store", metavar="URL", help="local folder, file:///… or s3://…")
    shared.add_argument("--json", metavar="PATH", help="write the result there too; - for stdout")
    kind = argparse.ArgumentParser(add_help=False, parents=[shared])
    kind.add_argument("--kind", choices=("episode", "recording"), help="both when not given")
    words = parser.add_subparsers(dest="command", required=True)
    words.add_parser("serve", help="answer over HTTP", add_help=False)
    listing = words.add_parser("list", parents=[kind], help="what is in the store")
    listing.add_argument("--task")
    listing.add_argument("--domain", choices=("human", "robot"))
    listing.add_argument("--origin", choices=("recorded", "twin", "imagined"), help="episodes only")
    listing.add_argument("--trash", action="store_true", help="what was deleted instead")
    show = words.add_parser("show", parents=[kind], help="attributes and streams of one")
    show.add_argument("id")
    _add_ids(words.add_parser("verify", parents=[kind], help="read everything, name all damage"))
    repair = words.add_parser(
        "repair", parents=[kind], help="complete what was interrupted, mend or salvage damage"
    )
    _add_ids(repair)
    repair.add_argument("--from", dest="source", metavar="URL", help="another copy of the store")
    _add_ids(words.add_parser("migrate", parents=[kind], help="bring older versions over"))
    _add_delete(words.add_parser("delete", parents=[kind], help="into the trash, or for good"))
    restore = words.add_parser("restore", parents=[shared], help="out of the trash again")
    restore.add_argument("--kind", choices=TRASH_KINDS, help="needed where an id has several")
    restore.add_argument("ids", nargs="+")
    purge = words.add_parser("purge", parents=[shared], help="empty the trash for good")
    purge.add_argument(
        "--older-than", type=_age, default=0.0, metavar="AGE", help="such as 30d or 12h"
    )
    return parser


def _age(text: str) -> float:
    try:
        return seconds_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _add_ids(word: argparse.ArgumentParser) -> None:
    word.add_argument("ids", nargs="*", help="all when none is named")


def _add_delete(word: argparse.ArgumentParser) -> None:
    word.add_argument("ids", nargs="*")
    word.add_argument("--for-good", action="store_true", help="not into the trash")
    word.add_argument("--operator", metavar="P", help="all that stems from this pseudonym")
    word.add_argument("--recording", metavar="ID", help="this recording")
    word.add_argument("--derived", action="store_true", help="and all that was made from it")
    word.add_argument("--yes", action="store_true", help="do not ask")
    word.add_argument("--receipt", metavar="PATH", help="where the proof goes")
    word.add_argument("--checkpoints", metavar="FOLDER", help="models to search as well")


if __name__ == "__main__":
    sys.exit(main())
