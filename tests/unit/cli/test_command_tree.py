"""Every command of `dextouch`: its name, help, example, flags and --json."""

import argparse
import contextlib
import re
import shlex
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from services.cli import main

COMMANDS = """
align markers, align report, align retarget, align run, align serve,
checkpoint, completion, config example, config show, dashboard, demo,
doctor, evaluate, evaluate prediction, evaluate recorded, export, generate, import,
rate report, rate serve, serve,
station bridge libsurvive, station bridge lsl, station bridge manus, station bridge openvr,
station bridge openxr,
station calibrate camera, station calibrate glove, station calibrate hand-eye,
station calibrate latency, station calibrate profile, station calibrate robot-base,
station calibrate show, station calibrate time, station calibrate wrist, station enrol,
station serve,
store backup, store clicks, store delete, store deletions, store enrol, store list, store merge,
store note, store purge, store relabel, store repair, store restore, store restore-backup,
store revoke, store serve, store show, store stations, store trim, store verify,
study report, study run, study serve, teleop serve,
train adapt, train cache, train data, train distill, train imagined, train judge, train policy,
train tokenizer, train world-model,
twin record, twin serve, up
"""
NAMES = [" ".join(name.split()) for name in COMMANDS.split(",")]
# Services run until they are stopped and answer over HTTP: they have no result to write.
WITHOUT_JSON = {
    "align serve", "dashboard", "rate serve", "serve", "station serve", "store serve",
    "study serve", "teleop serve", "twin serve",
    # These print a file.
    "align markers", "completion", "config example",
}  # fmt: skip
GROUPS = {
    "": tuple(name for name in main.COMMANDS if " " not in name),
    "train": tuple(main.commands_of("train")),
    "station": tuple(main.commands_of("station")),
    "rate": tuple(main.commands_of("rate")),
    "teleop": tuple(main.commands_of("teleop")),
    "config": tuple(main.commands_of("config")),
}
EXAMPLE = re.compile(r"^examples?:\n((?:  .*(?:\n|$))+)", re.MULTILINE | re.IGNORECASE)
DOCUMENT = Path(__file__).parents[3] / "docs" / "command_line.md"


class Help(NamedTuple):
    """What `--help` printed, and the parser that printed it; None where a table did."""

    text: str
    parser: argparse.ArgumentParser | None


@cache
def help_of(name: str) -> Help:
    """Run a command with --help."""
    printed: list[tuple[argparse.ArgumentParser, str]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "100")
        patch.setattr(
            argparse.ArgumentParser,
            "print_help",
            lambda parser, file=None: printed.append((parser, parser.format_help())),
        )
        try:
            status = main.main([*name.split(), "--help"])
        except SystemExit as end:
            status = end.code
    assert status in {0, None}
    return Help(printed[0][1], printed[0][0]) if printed else Help("", None)


def commands_below(name: str) -> list[str]:
    """The commands of a group; the command itself if it is none."""
    words = GROUPS.get(name)
    if words is None:
        parser = help_of(name).parser
        assert parser is not None, name
        inner = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        # Commands with classes of settings are listed there, not by the parser.
        own = dict.fromkeys([*inner[0].choices, *main.commands_of(name)]) if inner else {}
        words = tuple(own)
    if not words:
        # A command may have others below it, such as `evaluate prediction`.
        return [name, *(f"{name} {word}" for word in main.commands_of(name))]
    return [leaf for word in words for leaf in commands_below(f"{name} {word}".strip())]


def flags_of(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Arguments that help shows."""
    return [action for action in parser._actions if action.help != argparse.SUPPRESS]


def test_the_list_of_commands_is_complete():
    assert sorted(commands_below("")) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_help_is_of_this_command_and_shows_how_to_call_it(name):
    text, parser = help_of(name)
    assert text.startswith(f"usage: dextouch {name} ")
    assert not re.search(r"(tuple|dict|list)\[|\bnull\b|default factory|==SUPPRESS==", text)
    examples = re.sub(r"\\\n\s*", " ", "".join(EXAMPLE.findall(text)))
    # A remark may follow an example after some space.
    lines = [re.split(r"\s{4,}", line.strip())[0] for line in examples.splitlines()]
    own = [line for line in lines if f"{line} ".startswith(f"dextouch {name} ")]
    assert own, f"no example of `dextouch {name}` in its help"
    for line in own:
        parser.parse_args(shlex.split(line)[1 + len(name.split()) :])


@pytest.mark.parametrize("name", NAMES)
def test_flags_have_dashes_and_say_what_they_are(name):
    for action in flags_of(help_of(name).parser):
        assert not any("_" in flag for flag in action.option_strings)
        words = re.sub(r"\((default|required).*\)", "", action.help or "")
        assert words, f"{name}: {action.dest} has no help"


@pytest.mark.parametrize("name", NAMES)
def test_results_are_written_as_json(name):
    flags = {
        flag: action for action in flags_of(help_of(name).parser) for flag in action.option_strings
    }
    assert ("--json" in flags) == (name not in WITHOUT_JSON)
    if name not in WITHOUT_JSON:
        assert flags["--json"].metavar == "PATH"
        assert "- for standard output" in " ".join(flags["--json"].help.split())


@pytest.mark.parametrize("group", [name for name in GROUPS if name])
def test_groups_list_their_commands(group, capsys):
    with contextlib.suppress(SystemExit):
        main.main([group, "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: dextouch {group} ")
    listed = {line.split()[0] for line in text.splitlines() if re.match(r"  [a-z]", line)}
    assert set(GROUPS[group]) <= listed


def test_the_document_has_every_command():
    text = DOCUMENT.read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| `dextouch ([a-z -]+)` \|", text, re.MULTILINE)) == sorted(NAMES)
