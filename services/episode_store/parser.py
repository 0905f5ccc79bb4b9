"""Command line of `dextouch store`; importing it opens no store."""

import argparse
import math
from pathlib import Path
from typing import TypeAlias

from dextouch.command_line import CommandParser, add_json

_Commands: TypeAlias = "argparse._SubParsersAction[CommandParser]"  # noqa: SLF001 - has no public name
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


def _seconds(text: str) -> float:
    """Parse seconds of an item, for argparse; a year is more than any has."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not abs(seconds) < 366 * _UNITS["d"]:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected seconds, such as 2.5")
    return seconds


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
    _add_flag(listing, "--trash", "list the trash instead")
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
    _add_edits(commands, kind)
    _add_backups(commands, shared)
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


def _add_edits(commands: _Commands, kind: CommandParser) -> None:
    """Add the commands that make new items of others."""
    edit = CommandParser(add_help=False)
    _add_flag(edit, "--dry-run", "only say what would happen")
    _add_flag(edit, "--keep", "keep the source as superseded, not in the trash")
    edit.add_argument(
        "--as", dest="new_id", metavar="ID", help="of the result (default: ID-trimmed-1 …)"
    )
    edit.add_argument(
        "--outcome",
        choices=("keep", "success", "failure", "unknown"),
        help="of the result; needed where the source's may not hold any more",
    )
    both = (kind, edit)
    does = "write a span of an episode or recording as a new one"
    trim = _command(commands, both, "trim", does, "take-7 --from 1.5 --to 8 --outcome keep")
    trim.add_argument("id", metavar="ID", help="of the source")
    _add_span(trim, "seconds after step 0 of an episode or the start of a recording")
    trim.add_argument(
        "--steps", type=int, nargs=2, metavar=("FIRST", "STOP"), help="steps FIRST … STOP - 1"
    )
    _add_flag(trim, "--exact", "encode H.264 anew where a group is cut in two")
    does = "write items with other attributes as new ones"
    usual = "take-7 take-8 --instruction 'stand the bottle up'"
    relabel = _command(commands, both, "relabel", does, usual)
    relabel.add_argument("ids", nargs="+", metavar="ID", help="of the sources")
    relabel.add_argument("--task", metavar="TASK", help="new task")
    relabel.add_argument("--instruction", metavar="TEXT", help="new instruction")
    relabel.add_argument("--operator", metavar="P", help="new pseudonym of the operator")
    does = "list, add or remove notes on time ranges of an item"
    note = _command(commands, (kind,), "note", does, "take-7 --from 2 --to 3.5 --text 'it slips'")
    note.add_argument("id", metavar="ID", help="of an episode or recording")
    _add_span(note, "seconds, as of trim")
    note.add_argument("--text", metavar="TEXT", help="add a note of this text")
    note.add_argument("--author", metavar="P", help="pseudonym of who writes it")
    note.add_argument("--remove", type=int, metavar="N", help="remove the note of this number")
    own = CommandParser(add_help=False)
    add_json(own)
    _add_flag(own, "--dry-run", "only say what would happen")
    does = "copy all items of stores into one"
    merge = _command(
        commands, (own,), "merge", does, "bench-1/store bench-2/store --into data/store"
    )
    merge.add_argument("sources", nargs="+", metavar="STORE", help="to copy from, unchanged")
    merge.add_argument(
        "--into", dest="store", required=True, metavar="URL", help="store to copy into"
    )
    _add_flag(merge, "--rename", "give items a new id where it is taken")


def _add_backups(commands: _Commands, shared: CommandParser) -> None:
    does = "bring a backup up to date, while the store is in use"
    backup = _command(commands, shared, "backup", does, "/mnt/backup/store")
    backup.add_argument("target", metavar="TO", help="folder on another disk, or s3://…")
    _add_flag(
        backup, "--accept-deletions", "also if more than half of the backup is gone from the store"
    )
    does = "restore a store from its backup, and verify it"
    restoring = _command(commands, shared, "restore-backup", does, "/mnt/backup/store")
    restoring.add_argument("source", metavar="FROM", help="the backup")


def _add_flag(command: argparse.ArgumentParser, name: str, does: str) -> None:
    command.add_argument(name, action="store_true", help=does)


def _add_span(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument("--from", dest="from_s", type=_seconds, metavar="S", help=f"start: {what}")
    command.add_argument("--to", dest="to_s", type=_seconds, metavar="S", help="end, not included")


def _command(
    commands: _Commands,
    shared: CommandParser | tuple[CommandParser, ...],
    name: str,
    does: str,
    usual: str = "",
) -> argparse.ArgumentParser:
    """Add a command; `usual` are the arguments of its example."""
    return commands.add_parser(
        name,
        parents=shared if isinstance(shared, tuple) else [shared],
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
    _add_flag(command, "--for-good", "delete permanently, without trash")
    command.add_argument("--operator", metavar="P", help="all data of this operator pseudonym")
    command.add_argument("--recording", metavar="ID", help="delete this recording")
    _add_flag(command, "--derived", "also everything derived from it")
    _add_flag(
        command,
        "--unsent",
        "with --operator: also if the store has nothing of him and only stations may",
    )
    _add_flag(command, "--yes", "skip the confirmation")
    command.add_argument(
        "--receipt", type=Path, metavar="PATH", help="file for the deletion receipt"
    )
    command.add_argument(
        "--checkpoints", type=Path, metavar="FOLDER", help="also search the models in this folder"
    )
