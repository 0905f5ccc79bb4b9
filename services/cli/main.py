"""Entry point `dextouch COMMAND`: dispatches to commands and prints errors as one line."""

import importlib
import sys
from collections.abc import Sequence
from typing import NamedTuple

from dextouch import __version__
from dextouch.command_line import messages_aside
from dextouch.errors import DexTouchError, UnknownNameError
from services.cli.extras import missing_package


class Command(NamedTuple):
    """A command: the module whose `main(argv)` runs it, and its summary.

    `before` holds words inserted before the arguments.
    """

    module: str
    does: str
    before: tuple[str, ...] = ()


COMMANDS = {
    "demo": Command("services.cli.demo", "record, align, imagine and score on this machine"),
    "up": Command("services.cli.up", "run every service in one process, with a dashboard"),
    "doctor": Command("services.cli.doctor", "check what this machine can do and what is missing"),
    "twin": Command(
        "services.twin.__main__", "record true episodes in the physics twin, or serve it"
    ),
    "station": Command("services.acquisition.__main__", "record and calibrate a station's devices"),
    "store": Command(
        "services.episode_store.__main__",
        "list, show, verify, repair, migrate, delete, restore, purge, serve",
    ),
    "export": Command(
        "services.cli.exports", "write LeRobot, MCAP, Rerun or UMI files from a store", ("export",)
    ),
    "import": Command(
        "services.cli.exports", "read LeRobot, MCAP or UMI files into a store", ("import",)
    ),
    "align": Command("services.alignment.__main__", "turn recordings into synchronized episodes"),
    "train": Command("services.cli.train", "train the world model, a policy or the success probe"),
    "checkpoint": Command(
        "services.world_model.__main__",
        "show the provenance and accuracy of a world model",
        ("show",),
    ),
    "serve": Command(
        "services.world_model.__main__", "serve the world model's rollouts", ("serve",)
    ),
    "evaluate": Command(
        "services.evaluation.__main__", "score policies in real and imagined worlds", ("run",)
    ),
    "dashboard": Command("services.dashboard.__main__", "serve the operators' page"),
}

# Subcommands of a group whose module has none; without one, the group runs its module.
INNER_COMMANDS = {
    ("station", "serve"): Command(
        "services.acquisition.__main__", "record gloves, trackers and cameras"
    ),
    ("station", "calibrate"): Command(
        "services.cli.calibrate", "measure tare and gain, lenses and mounts"
    ),
}

EXIT_USAGE = 2
EXIT_REFUSED = 3


def usage() -> str:
    """The text of `dextouch --help`."""
    named = {**COMMANDS, **{" ".join(words): inner for words, inner in INNER_COMMANDS.items()}}
    rows = [f"  {name:<19}{command.does}" for name, command in named.items()]
    return "\n".join(
        [
            "usage: dextouch COMMAND [options]",
            "       dextouch GROUP COMMAND [options]",
            "",
            "Collect human and robot touch, train a world model on it, evaluate policies in it.",
            "",
            *rows,
            "",
            "Every command has --help; commands that terminate write their result with",
            "--json PATH, or --json - for standard output. A service (serve, station serve, …)",
            "takes its flags as variables too. All commands: docs/command_line.md",
            "",
            "example:",
            "  dextouch demo",
        ]
    )


def group_usage(group: str) -> str:
    """The help of a group of `INNER_COMMANDS`."""
    inner = {word: entry for (name, word), entry in INNER_COMMANDS.items() if name == group}
    rows = [f"  {word:<11}{command.does}" for word, command in inner.items()]
    return "\n".join(
        [
            f"usage: dextouch {group} COMMAND [options]",
            "",
            *rows,
            "",
            f"Help for one of them: dextouch {group} {next(iter(inner))} --help",
        ]
    )


def find_command(name: str, rest: Sequence[str]) -> tuple[str, Command, list[str]]:
    """Resolve a command.

    Args:
        name: name in `COMMANDS`.
        rest: remaining arguments.

    Returns:
        Full name of the command, the command, and its arguments.

    Raises:
        UnknownNameError: an unknown subcommand.
    """
    inner = {word: command for (outer, word), command in INNER_COMMANDS.items() if outer == name}
    first = rest[0] if rest else ""
    if first in inner:
        return f"{name} {first}", inner[first], list(rest[1:])
    if inner and first and not first.startswith("-"):
        raise UnknownNameError("word", first, list(inner))
    return name, COMMANDS[name], list(rest)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        Its exit status; 2 for an unknown command, 3 for a refusal with its reason on stderr.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in {"-h", "--help", "help"}:
        print(usage())
        return 0
    if arguments[0] == "--version":
        print(f"dextouch {__version__}")
        return 0
    name, *rest = arguments
    if name not in COMMANDS:
        print(f"dextouch: unknown command {name!r}\n\n{usage()}", file=sys.stderr)
        return EXIT_USAGE
    if rest in (["-h"], ["--help"]) and any(group == name for group, _ in INNER_COMMANDS):
        print(group_usage(name))
        return 0
    return _run(name, rest)


def _run(name: str, rest: list[str]) -> int:
    """Run one command; a refusal or a missing package is printed as one line."""
    try:
        name, command, rest = find_command(name, rest)
        module = importlib.import_module(command.module)
        with messages_aside(rest):
            return int(module.main([*command.before, *rest]) or 0)
    except ModuleNotFoundError as error:
        refusal = missing_package(error)
        if refusal is None:
            raise
    except DexTouchError as error:
        refusal = error
    except KeyboardInterrupt:
        print(f"dextouch {name}: interrupted", file=sys.stderr)
        return 130
    print(f"dextouch {name}: {refusal.message}", file=sys.stderr)
    return EXIT_REFUSED


if __name__ == "__main__":
    sys.exit(main())
