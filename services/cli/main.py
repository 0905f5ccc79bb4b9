"""`dextouch COMMAND …` in, the command's exit status out; errors we raise become one clear line."""

import importlib
import sys
from collections.abc import Sequence
from typing import NamedTuple

from dextouch import __version__
from dextouch.errors import DexTouchError, UnknownNameError
from services.cli.extras import missing_package


class Command(NamedTuple):
    """One word of the command line: the module whose `main(argv)` does it, and what it does.

    `before` are words put before the arguments.
    """

    module: str
    does: str
    before: tuple[str, ...] = ()


COMMANDS = {
    "demo": Command("services.cli.demo", "record, align, imagine and score on this machine"),
    "up": Command("services.cli.up", "run every service in one process, with a dashboard"),
    "doctor": Command("services.cli.doctor", "say what this machine can do and what is missing"),
    "twin": Command(
        "services.twin.__main__", "record truth episodes in the physics twin, or serve it"
    ),
    "station": Command("services.acquisition.__main__", "record gloves, trackers and cameras"),
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
    "serve": Command(
        "services.world_model.__main__", "serve the world model's rollouts", ("serve",)
    ),
    "evaluate": Command(
        "services.evaluation.__main__", "score policies in real and imagined worlds", ("run",)
    ),
    "bench": Command("services.cli.bench", "time a stage against its error, beside its rivals"),
    "stress": Command(
        "services.cli.stress.command", "feed every stage what breaks numerical code; tell what held"
    ),
}

# A second word that another module does.
INNER_COMMANDS = {
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
            "",
            "Collect human and robot touch, learn a world model from it, judge policies inside it.",
            "",
            *rows,
            "",
            "Every command explains itself with --help; those that end write their result with",
            "--json PATH. A service (station, serve, …) takes its flags as variables too.",
            "Start with: dextouch demo",
        ]
    )


def find_command(name: str, rest: Sequence[str]) -> tuple[str, Command, list[str]]:
    """The command that words mean.

    Args:
        name: of `COMMANDS`.
        rest: what stands behind it.

    Returns:
        The words of the command, what does it, and what is left for it.

    Raises:
        UnknownNameError: a word behind a command that takes flags and a few words only.
    """
    inner = {word: command for (outer, word), command in INNER_COMMANDS.items() if outer == name}
    first = rest[0] if rest else ""
    if first in inner:
        return f"{name} {first}", inner[first], list(rest[1:])
    if inner and first and not first.startswith("-"):
        raise UnknownNameError("word", first, list(inner))
    if inner and {"-h", "--help"} & set(rest):
        print("\n".join(f"also: dextouch {name} {word} --help" for word in inner), end="\n\n")
    return name, COMMANDS[name], list(rest)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        Its exit status; 2 for a word we do not know, 3 for a refusal with a reason on stderr.
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
    return _run(name, rest)


def _run(name: str, rest: list[str]) -> int:
    """One command's exit status; a refusal and a package that is not installed are one line."""
    try:
        name, command, rest = find_command(name, rest)
        module = importlib.import_module(command.module)
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
