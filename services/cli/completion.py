"""Command `dextouch completion`: prints a script that completes commands and flags in a shell."""

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from dextouch.command_line import CommandParser, parser_behind
from dextouch.errors import DexTouchError

SHELLS: Final = ("bash", "zsh", "fish")
_FOLDERS: Final = {"FOLDER", "DIRECTORY"}
_FILES: Final = {"PATH", "FILE"}
# As settings show the values of a literal.
_CHOICES: Final = re.compile(r"\{([\w,.-]+)\}")


def command_tree(targets: Mapping[str, tuple[str, str]]) -> argparse.ArgumentParser:
    """Parser of the whole program, for shells; `targets` are summaries and `module:function`s."""
    root = CommandParser(prog="dextouch")
    root.add_argument("--version", action="store_true", help="print the version")
    root.add_subparsers(dest="command")
    # Groups come before the commands in them.
    for name in sorted(targets):
        *above, word = name.split()
        parser = root
        for one in above:
            parser = _inner(parser).choices[one]
        does, target = targets[name]
        own = _parser_of(name) if target else None
        inner = _inner(parser)
        if word in inner.choices:
            # The parser above names it in its help.
            del inner.choices[word]
            listed = inner._choices_actions  # noqa: SLF001
            listed[:] = [one for one in listed if one.dest != word]
        # The original's --help is among its arguments.
        parents: Any = [] if own is None else [own]
        inner.add_parser(
            word, help=does, parents=parents, add_help=own is None, conflict_handler="resolve"
        )
    return root


def _inner(parser: argparse.ArgumentParser) -> "argparse._SubParsersAction[CommandParser]":
    """The commands of a parser, which get a place if there are none yet."""
    for action in parser._actions:  # noqa: SLF001 - argparse has no other way to ask
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            return action
    return parser.add_subparsers(dest="command", parser_class=CommandParser)


def _parser_of(name: str) -> argparse.ArgumentParser | None:
    """Parser of a command; None where a package is missing."""
    from services.cli.main import run_command

    try:
        return parser_behind(lambda: run_command([*name.split(), "--help"]))
    except (ModuleNotFoundError, DexTouchError):
        return None


def _prepare(parser: argparse.ArgumentParser) -> None:
    """Mark the arguments that take a file or folder, and leave choices that can be typed."""
    import shtab

    for action in parser._actions:  # noqa: SLF001
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            for inner in action.choices.values():
                _prepare(inner)
            continue
        if action.choices is not None:
            action.choices = [str(one) for one in action.choices if isinstance(one, str | int)]
        elif isinstance(action.metavar, str) and (named := _CHOICES.fullmatch(action.metavar)):
            action.choices = named[1].split(",")
        if action.metavar in _FOLDERS:
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
        elif action.type is Path or action.metavar in _FILES:
            action.complete = shtab.FILE  # type: ignore[attr-defined]


def main(argv: Sequence[str]) -> int:
    """Print the script of a shell."""
    parser = CommandParser(
        prog="dextouch completion",
        description="Print a script with which a shell completes commands and flags. It knows the "
        "commands whose extras are installed; make it again after an update. Save it as "
        "~/.local/share/bash-completion/completions/dextouch (bash), "
        "~/.config/fish/completions/dextouch.fish (fish), or _dextouch in a folder of fpath (zsh).",
        epilog="example:\n  dextouch completion bash",
    )
    parser.add_argument("shell", choices=SHELLS, help="bash, zsh or fish")
    shell = parser.parse_args(list(argv)).shell
    import shtab

    from services.cli.main import COMMANDS

    tree = command_tree({name: (one.does, one.target) for name, one in COMMANDS.items()})
    _prepare(tree)
    print(shtab.complete(tree, shell=shell))
    return 0
