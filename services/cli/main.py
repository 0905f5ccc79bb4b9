"""Entry point `dextouch COMMAND`: dispatches to commands and prints errors as one line."""

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dextouch import __version__
from dextouch.command_line import messages_aside
from dextouch.errors import DexTouchError, UnknownNameError
from dextouch.free_text import printable
from services.cli.extras import missing_package
from services.cli.standard_streams import StandardStreams


class Command(NamedTuple):
    """A command: its summary, and `module:function` of `services`; a bare group has none.

    Its help imports nothing else than `flags`: the section of its settings, `module:NAME_parser`,
    which makes its parser, or `module:NAME_settings`, which finds the class of its settings from
    the arguments.
    """

    does: str
    target: str = ""
    flags: str = ""


COMMANDS = {
    "demo": Command(
        "record, align, predict and evaluate on this machine",
        "pipelines.demo:main",
        "pipelines.parsers:demo_parser",
    ),
    "up": Command("run every service in one process, with a dashboard", "cli.up:main", "up"),
    "doctor": Command("check what this machine can do and what is missing", "cli.doctor:main"),
    "twin": Command(
        "record ground-truth episodes in the physics twin, or serve it",
        "twin.command_line:main",
        "twin.parser:twin_parser",
    ),
    "twin serve": Command("serve rollouts in the twin", "twin.world:serve", "twin"),
    "station": Command("record and calibrate a station's devices"),
    "station serve": Command(
        "record gloves, trackers and cameras", "pipelines.station:main", "acquisition"
    ),
    "station bridge": Command(
        "serve samples of other makers' trackers and programs to stations",
        "acquisition.sdk_bridges.command_line:main",
        "acquisition.sdk_bridges.parser:bridge_parser",
    ),
    "station enrol": Command(
        "exchange a one-time token for the station's key of the store",
        "cli.enrolment:station_enrol_main",
    ),
    "station calibrate": Command(
        "calibrate gloves, cameras and latencies", "pipelines.calibrate:main"
    ),
    "store": Command(
        "list, show, verify, clicks, note, trim, relabel, merge, repair, delete, …",
        "episode_store.command_line:main",
        "episode_store.parser:store_parser",
    ),
    "store serve": Command("serve the store over HTTP", "episode_store.app:main", "episode_store"),
    "store enrol": Command(
        "get a one-time token with which a station gets its key", "cli.enrolment:store_enrol_main"
    ),
    "store stations": Command("list enrolled stations", "cli.enrolment:store_stations_main"),
    "store revoke": Command(
        "revoke the key of an enrolled station", "cli.enrolment:store_revoke_main"
    ),
    "export": Command(
        "write LeRobot, MCAP, Rerun or UMI files from a store",
        "cli.exports:export_main",
        "pipelines.parsers:export_parser",
    ),
    "import": Command(
        "read LeRobot, MCAP or Rerun files into a store",
        "cli.exports:import_main",
        "pipelines.parsers:import_parser",
    ),
    "align": Command(
        "convert recordings to synchronized episodes",
        "alignment.command_line:main",
        "alignment.settings:default_parser",
    ),
    "align serve": Command("serve alignment over HTTP", "alignment.app:main", "alignment"),
    "teleop": Command("follow a tracked hand live with a robot hand"),
    "teleop serve": Command(
        "serve commands for a robot hand that follows a tracked one",
        "pipelines.teleoperation.app:main",
        "teleoperation",
    ),
    "train": Command("train the world model, its success classifier, or a policy"),
    "train data": Command(
        "record training episodes in the twin",
        "pipelines.training_data:main",
        "pipelines.parsers:training_data_parser",
    ),
    "train tokenizer": Command(
        "train a tactile tokenizer for the paper's form of the world model",
        "pipelines.train_tokenizer:main",
        "world_model_train_tokenizer",
    ),
    "train world-model": Command(
        "train a world model on episodes of robots and people, of either form",
        "world_model.command_line:run_train",
        "world_model.paper_settings:train_settings",
    ),
    "train distill": Command(
        "train a world model in the paper's form to sample in few steps",
        "world_model.command_line:run_distill",
        "world_model_distill",
    ),
    "train adapt": Command(
        "adapt a world model of either form to new tasks",
        "world_model.command_line:run_adapt",
        "world_model.paper_settings:adapt_settings",
    ),
    "train imagined": Command(
        "predict the episodes of a store with the world model",
        "pipelines.imagined_data:imagined_main",
        "pipelines.parsers:imagined_parser",
    ),
    "train policy": Command(
        "train a policy on demonstrations",
        "pipelines.place_policy:run_train_policy",
        "evaluation_train_policy",
    ),
    "train judge": Command(
        "train the success classifier on true and imagined episodes",
        "evaluation.command_line:run_train_judge",
        "evaluation_train_probe",
    ),
    "generate": Command(
        "generate demonstrations from the actions of recorded ones",
        "pipelines.imagined_data:generate_main",
        "pipelines.parsers:generate_parser",
    ),
    "checkpoint": Command(
        "show the provenance and accuracy of a world model",
        "world_model.command_line:run_show",
        "world_model_show",
    ),
    "serve": Command(
        "serve the world model's rollouts", "world_model.command_line:run_serve", "world_model"
    ),
    "evaluate": Command(
        "score policies in real and imagined worlds",
        "evaluation.command_line:run_evaluation",
        "evaluation_run",
    ),
    "evaluate prediction": Command(
        "measure predicted images and touch on held-out episodes",
        "pipelines.evaluate:prediction_main",
        "pipelines.parsers:prediction_parser",
    ),
    "evaluate recorded": Command(
        "score policies from recorded first observations, and how far to trust it",
        "pipelines.evaluate:recorded_main",
        "pipelines.parsers:recorded_parser",
    ),
    "study": Command(
        "score policies in several worlds, defined in a file and resumable",
        "pipelines.study:main",
        "pipelines.parsers:study_parser",
    ),
    "study serve": Command(
        "serve the results of studies to the dashboard", "evaluation.studies.app:main", "studies"
    ),
    "rate": Command("score rollouts by human raters, and measure their agreement"),
    "rate serve": Command(
        "serve the page on which raters mark rollouts", "evaluation.rating.app:main", "rating"
    ),
    "rate report": Command(
        "print scores and the agreement of raters",
        "evaluation.rating.command_line:report_main",
        "rating_report",
    ),
    "dashboard": Command("serve the operators' page", "dashboard.app:main", "dashboard"),
    "config": Command("show the effective settings, or an example of dextouch.toml"),
    "config show": Command(
        "show the effective settings and where each comes from", "cli.configuration:show_main"
    ),
    "config example": Command(
        "print a dextouch.toml with all settings", "cli.configuration:example_main"
    ),
    "completion": Command("print the completion script of a shell", "cli.completion:main"),
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
    return _found(command.target)(arguments) or 0


def _found(place: str) -> Any:  # noqa: ANN401 - functions and classes
    module, _, name = place.partition(":")
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
