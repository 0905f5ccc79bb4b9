"""Command line of `dextouch store`; importing it opens no store."""

import argparse
from pathlib import Path

from dextouch.command_line import CommandParser, add_json

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}
_DELETIONS = "list permanent deletions and what stations have yet to remove"


def seconds_of(text: str) -> float:
    """Parse a duration such as `30d`, `12h`, `90m` or `10s` to seconds, for argparse."""
    factor = _UNITS.get(text[-1:])
    if factor is None or not text[:-1].isdecimal():
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected a number and one of s m h d, such as 30d"
        )
    return int(text[:-1]) * factor


def store_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch store`."""
    parser = CommandParser(
        prog="dextouch store",
        description="Inspect, repair or serve a store ('serve --help' lists the settings).",
        epilog="example:\n  dextouch store list --store data/store",
    )
    shared = CommandParser(add_help=False)
    shared.add_argument("--store", metavar="URL", help="local folder, file:///… or s3://…")
    add_json(shared)
    kind = CommandParser(add_help=False, parents=[shared])
    kind.add_argument("--kind", choices=("episode", "recording"), help="default: both")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    commands.add_parser("serve", help="serve the store over HTTP", add_help=False)
    commands.add_parser("enrol", help="get a one-time token for a station", add_help=False)
    commands.add_parser("stations", help="list enrolled stations", add_help=False)
    commands.add_parser("revoke", help="revoke the key of a station", add_help=False)
    listing = _command(commands, kind, "list", "list episodes and recordings")
    listing.add_argument("--task", metavar="TASK", help="only of this task")
    listing.add_argument("--domain", choices=("human", "robot"), help="only of these hands")
    listing.add_argument("--origin", choices=("recorded", "twin", "imagined"), help="episodes only")
    listing.add_argument("--trash", action="store_true", help="list the trash instead")
    show = _command(commands, kind, "show", "show attributes and streams of an item", "take-7")
    show.add_argument("id", metavar="ID", help="of an episode or recording")
    _add_ids(_command(commands, kind, "verify", "verify all checksums and list damage"))
    does = "check clicks on objects and list the places that they and touch give"
    clicked = _command(commands, shared, "clicks", does, "--clicks objects.json --json clicks.json")
    clicked.add_argument(
        "--clicks",
        type=Path,
        required=True,
        metavar="FILE",
        help="objects of the tasks, with or without clicks on them; those in the store are added",
    )
    repairing = _command(
        commands, kind, "repair", "repair or salvage damaged items", "take-7 --from /mnt/copy"
    )
    _add_ids(repairing)
    repairing.add_argument(
        "--from", dest="source", metavar="URL", help="intact copy of the store to repair from"
    )
    does = "move items to the trash, or delete them permanently"
    _add_delete(_command(commands, kind, "delete", does, "take-7 take-8"))
    _add_deletions(_command(commands, shared, "deletions", _DELETIONS))
    restore = _command(commands, shared, "restore", "restore items from the trash", "take-7")
    restore.add_argument(
        "--kind",
        choices=("episode", "recording", "upload"),
        help="required if an id has several kinds",
    )
    restore.add_argument("ids", nargs="+", metavar="ID", help="of what is restored")
    does = "permanently delete items in the trash"
    purge = _command(commands, shared, "purge", does, "--older-than 30d")
    purge.add_argument(
        "--older-than",
        type=seconds_of,
        default=0.0,
        metavar="AGE",
        help="items deleted longer ago than this, such as 30d or 12h",
    )
    return parser


def _command(
    commands: "argparse._SubParsersAction[CommandParser]",
    shared: CommandParser,
    name: str,
    does: str,
    usual: str = "",
) -> argparse.ArgumentParser:
    """Add a command; `usual` are the arguments of its example."""
    return commands.add_parser(
        name,
        parents=[shared],
        help=does,
        description=f"{does[0].upper()}{does[1:]}.",
        epilog=f"example:\n  dextouch store {name} {usual}".rstrip(),
    )


def _add_ids(command: argparse.ArgumentParser) -> None:
    command.add_argument("ids", nargs="*", metavar="ID", help="default: all")


def _add_deletions(command: argparse.ArgumentParser) -> None:
    chosen = command.add_mutually_exclusive_group()
    chosen.add_argument("--operator", metavar="P", help="only that of this operator pseudonym")
    chosen.add_argument("--recording", metavar="ID", help="only that of this recording")
    command.add_argument("--readmit", metavar="P", help="let a deleted operator record again")
    command.add_argument(
        "--settle", metavar="STATION", help="state that its spool no longer exists"
    )


def _add_delete(command: argparse.ArgumentParser) -> None:
    command.add_argument("ids", nargs="*", metavar="ID", help="of what is deleted")
    command.add_argument(
        "--for-good", action="store_true", help="delete permanently, without trash"
    )
    command.add_argument("--operator", metavar="P", help="all data of this operator pseudonym")
    command.add_argument("--recording", metavar="ID", help="delete this recording")
    command.add_argument("--derived", action="store_true", help="also everything derived from it")
    command.add_argument(
        "--unsent",
        action="store_true",
        help="with --operator: also if the store has nothing of him and only stations may",
    )
    command.add_argument("--yes", action="store_true", help="skip the confirmation")
    command.add_argument(
        "--receipt", type=Path, metavar="PATH", help="file for the deletion receipt"
    )
    command.add_argument(
        "--checkpoints", type=Path, metavar="FOLDER", help="also search the models in this folder"
    )
