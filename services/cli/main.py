"""Entry point `dextouch COMMAND`: dispatches to commands and prints errors as one line."""

import argparse
import importlib
import os
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dextouch import __version__
from dextouch.command_line import garbage_collection_paused, messages_aside
from dextouch.errors import DexTouchError, UnknownNameError
from dextouch.free_text import printable
from services.cli.extras import missing_package
from services.cli.standard_streams import StandardStreams


class Command(NamedTuple):
    """A command: its summary, what runs it, and what its help needs (commands.toml)."""

    does: str
    target: str = ""
    flags: str = ""


COMMANDS = {
    name: Command(**one)
    for name, one in tomllib.loads(
        Path(__file__).with_name("commands.toml").read_text(encoding="utf-8")
    ).items()
}

EXIT_USAGE = 2  # as argparse
EXIT_REFUSED = 3  # a refusal with a reason, unlike a crash (1)

USAGE = """\
usage: dextouch COMMAND [options]
       dextouch GROUP COMMAND [options]

Record touch, images and motion of human and robot hands, train a world model on them,
and evaluate policies in it.

{rows}

Every command has --help; commands that terminate write their result with
--json PATH, or --json - for standard output. Services (serve, station serve, …) also
read their flags from environment variables and dextouch.toml (see config), where
`data = "FOLDER"` names the data folder of all commands.
All commands: docs/command_line.md

example:
  dextouch demo"""


def commands_of(group: str) -> dict[str, Command]:
    """The commands of a group that have a row in `COMMANDS`, by their last word."""
    prefix = f"{group} "
    return {name.removeprefix(prefix): c for name, c in COMMANDS.items() if name.startswith(prefix)}


def _group_usage(group: str) -> str:
    inner = commands_of(group)
    rows = "\n".join(f"  {word:<14}{command.does}" for word, command in inner.items())
    return (
        f"usage: dextouch {group} COMMAND [options]\n\n{rows}\n\n"
        f"Help for one of them: dextouch {group} {next(iter(inner))} --help"
    )


def find_command(words: Sequence[str]) -> tuple[str, list[str]]:
    """Name of the command that a command line runs, and its arguments."""
    first, second = words[0], words[1] if len(words) > 1 else ""
    if first not in {name.partition(" ")[0] for name in COMMANDS}:
        raise UnknownNameError("command", first, [name for name in COMMANDS if " " not in name])
    if f"{first} {second}" in COMMANDS:
        return f"{first} {second}", list(words[2:])
    if not COMMANDS[first].target and second not in {"", "-h", "--help"}:
        raise UnknownNameError(f"dextouch {first} command", second, list(commands_of(first)))
    return first, list(words[1:])


def run_command(words: Sequence[str]) -> int:
    """Run a command line without the program's name, and return its exit status."""
    name, arguments = find_command(words)
    command = COMMANDS[name]
    if not command.target:
        print(_group_usage(name))
        return 0
    if command.flags and not {"-h", "--help"}.isdisjoint(arguments):
        _show_help(command.flags, arguments)
    _warn_of_unknown_variables(name, command.flags, arguments)
    return _found(command.target)(arguments) or 0


def _warn_of_unknown_variables(name: str, section: str, arguments: list[str]) -> None:
    # A warning, since some platforms set variables of such names themselves.
    if any(variable.startswith("DEXTOUCH_") for variable in os.environ):
        from dextouch.serving import section_of
        from services.cli.configuration import SECTIONS, unknown_variables

        if section.endswith("_settings"):
            section = section_of(_found(section)(arguments))
        if section in SECTIONS:
            for problem in unknown_variables(section, os.environ):
                print(f"dextouch {name}: warning: {printable(problem)}", file=sys.stderr)


def _found(place: str) -> Any:  # noqa: ANN401 - functions and classes
    module, _, name = place.partition(":")
    with garbage_collection_paused():
        return getattr(importlib.import_module(f"services.{module}"), name)


def _show_help(flags: str, arguments: list[str]) -> None:
    from dextouch.serving import load_settings
    from services.cli.configuration import SECTIONS

    found = _found(SECTIONS.get(flags, flags))
    if not isinstance(found, type):
        found = found(arguments) if flags.endswith("_settings") else found()
    if isinstance(found, argparse.ArgumentParser):
        found.parse_args(arguments)
    load_settings(found, ["--help"])


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    It is 1 if standard output cannot be written, 2 for an unknown command, 3 for a refusal with its
    reason on stderr, 141 if nobody reads the output any more (`| head`).
    """
    words = list(sys.argv[1:] if argv is None else argv)
    streams = StandardStreams()
    try:
        try:
            return _run(words, lambda: streams.failure is not None)
        finally:
            streams.flush()
    except (OSError, DexTouchError):
        failure = streams.failure
        if failure is None:
            raise
    return streams.status_after(failure, " ".join(words[:1]))


def _run(words: list[str], has_failed: Callable[[], bool]) -> int:
    if not words or words[0] in {"-h", "--help", "help"}:
        top_level = {name: command.does for name, command in COMMANDS.items() if " " not in name}
        print(
            USAGE.format(rows="\n".join(f"  {name:<19}{does}" for name, does in top_level.items()))
        )
        return 0
    if words[0] == "--version":
        print(f"dextouch {__version__}")
        return 0
    try:
        name, _ = find_command(words)
    except UnknownNameError as error:
        print(f"dextouch: {printable(error.message)}; see dextouch --help", file=sys.stderr)
        return EXIT_USAGE
    try:
        if os.environ.get("DEXTOUCH_CONFIG") or Path("dextouch.toml").is_file():
            from services.cli.configuration import apply_configuration

            apply_configuration()
        with messages_aside(words):
            return run_command(words)
    except ModuleNotFoundError as error:
        refusal = missing_package(error)
        if refusal is None:
            raise
    except DexTouchError as error:
        if isinstance(error.__cause__, OSError) and has_failed():
            raise  # Output that failed while a file was read.
        refusal = error
    except KeyboardInterrupt:
        print(f"dextouch {name}: interrupted", file=sys.stderr)
        return 130
    print(f"dextouch {name}: {printable(refusal.message, lines=True)}", file=sys.stderr)
    return EXIT_REFUSED


if __name__ == "__main__":
    sys.exit(main())
