"""Command line `dextouch store`: manage a store, or serve it over HTTP."""

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
    """Run a command of the store's command line; serve by default.

    Returns:
        0; 1 if something is damaged, remains or is not provably deleted; 3 for a refusal.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        if not arguments or arguments[0] == "serve":
            return _serve(arguments[1:])
        if arguments[0].startswith("--") and arguments[0] != "--help":
            return _serve(arguments)
        options = _parser().parse_args(arguments)
        # Items that the catalog leaves out are reported on stderr.
        configure_logging(service="episode_store", log_format="auto", level="warning")
        url = options.store or load_settings(EpisodeStoreSettings, []).store_url
        # With the result on stdout, messages go to stderr.
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
        description="Inspect, repair or serve a store ('serve --help' lists the settings).",
    )
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--store", metavar="URL", help="local folder, file:///… or s3://…")
    shared.add_argument(
        "--json", metavar="PATH", help="also write the result as JSON to this file; - for stdout"
    )
    kind = argparse.ArgumentParser(add_help=False, parents=[shared])
    kind.add_argument("--kind", choices=("episode", "recording"), help="default: both")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("serve", help="serve the store over HTTP", add_help=False)
    listing = commands.add_parser("list", parents=[kind], help="list episodes and recordings")
    listing.add_argument("--task")
    listing.add_argument("--domain", choices=("human", "robot"))
    listing.add_argument("--origin", choices=("recorded", "twin", "imagined"), help="episodes only")
    listing.add_argument("--trash", action="store_true", help="list the trash instead")
    show = commands.add_parser(
        "show", parents=[kind], help="show attributes and streams of an item"
    )
    show.add_argument("id")
    _add_ids(
        commands.add_parser("verify", parents=[kind], help="verify all checksums and list damage")
    )
    repairing = commands.add_parser(
        "repair", parents=[kind], help="complete interrupted items, repair or salvage damaged ones"
    )
    _add_ids(repairing)
    repairing.add_argument(
        "--from", dest="source", metavar="URL", help="intact copy of the store to repair from"
    )
    _add_ids(
        commands.add_parser(
            "migrate", parents=[kind], help="upgrade items of older format versions"
        )
    )
    _add_delete(
        commands.add_parser(
            "delete", parents=[kind], help="move items to the trash, or delete them permanently"
        )
    )
    restore = commands.add_parser("restore", parents=[shared], help="restore items from the trash")
    restore.add_argument("--kind", choices=TRASH_KINDS, help="required if an id has several kinds")
    restore.add_argument("ids", nargs="+")
    purge = commands.add_parser(
        "purge", parents=[shared], help="permanently delete items in the trash"
    )
    purge.add_argument(
        "--older-than", type=_age, default=0.0, metavar="AGE", help="such as 30d or 12h"
    )
    return parser


def _age(text: str) -> float:
    try:
        return seconds_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _add_ids(command: argparse.ArgumentParser) -> None:
    command.add_argument("ids", nargs="*", help="default: all")


def _add_delete(command: argparse.ArgumentParser) -> None:
    command.add_argument("ids", nargs="*")
    command.add_argument(
        "--for-good", action="store_true", help="delete permanently, without trash"
    )
    command.add_argument("--operator", metavar="P", help="all data of this operator pseudonym")
    command.add_argument("--recording", metavar="ID", help="delete this recording")
    command.add_argument("--derived", action="store_true", help="also everything derived from it")
    command.add_argument("--yes", action="store_true", help="skip the confirmation")
    command.add_argument("--receipt", metavar="PATH", help="file for the deletion receipt")
    command.add_argument(
        "--checkpoints", metavar="FOLDER", help="also search the models in this folder"
    )


if __name__ == "__main__":
    sys.exit(main())
