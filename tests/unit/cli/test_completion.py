"""Completion scripts in real shells."""

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

pytest.importorskip("shtab", reason="pip install shtab (extra serve)")
ROOT = Path(__file__).parents[3]


@cache
def script_of(shell):
    """The script that a user would save; made once, since it imports every command."""
    command = [sys.executable, "-m", "services.cli.main", "completion", shell]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    return done.stdout


def needs(shell):
    return pytest.mark.skipif(shutil.which(shell) is None, reason=f"no {shell} on the PATH")


# As bash does at the Tab key: it sets the words and calls the function that `complete` registered.
IN_BASH = """
source "$1"; shift
name=$(complete -p dextouch | sed 's/.*-F \\([^ ]*\\).*/\\1/')
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}
"$name" dextouch "${COMP_WORDS[$COMP_CWORD]}" "${COMP_WORDS[$((COMP_CWORD - 1))]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


def in_bash(tmp_path, *words):
    script = tmp_path / "dextouch.bash"
    script.write_text(script_of("bash"))
    command = ["bash", "--norc", "-c", IN_BASH, "bash", str(script), "dextouch", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert not done.stderr
    return {one.strip() for one in done.stdout.splitlines() if one.strip()}


@pytest.mark.long
@needs("bash")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["sta"], {"station"}),
        (["station", ""], {"serve", "calibrate"}),
        (["station", "calibrate", "gl"], {"glove"}),
        (["align", "s"], {"serve"}),
        (["evaluate", "pred"], {"prediction"}),
        (["store", "serve", "--store-u"], {"--store-url"}),
        (["dashboard", "--log-level", "w"], {"warning"}),
        (["completion", ""], {"bash", "zsh", "fish"}),
    ],
)
def test_bash_completes(words, expected, tmp_path):
    assert expected <= in_bash(tmp_path, *words)
    prefix = words[-1]
    assert all(one.startswith(prefix) for one in in_bash(tmp_path, *words))


@pytest.mark.long
@needs("bash")
def test_bash_completes_files(tmp_path):
    (tmp_path / "marks.sqlite").touch()
    assert in_bash(tmp_path, "rate", "serve", "--marks", "mar") == {"marks.sqlite"}


@needs("bash")
def test_every_command_is_known_to_bash(tmp_path):
    from services.cli.main import COMMANDS

    for name in COMMANDS:
        *above, word = name.split()
        assert word in in_bash(tmp_path, *above, word), name


@needs("zsh")
def test_zsh_accepts_the_script(tmp_path):
    """Only its syntax: zsh completes nothing without a terminal."""
    path = tmp_path / "_dextouch"
    path.write_text(script_of("zsh"))
    assert path.read_text().startswith("#compdef dextouch")
    subprocess.run(["zsh", "-n", str(path)], check=True)


@needs("fish")
def test_fish_completes(tmp_path):
    path = tmp_path / "dextouch.fish"
    path.write_text(script_of("fish"))
    asked = f"source {path}; complete -C 'dextouch stati'; complete -C 'dextouch station ser'"
    environment = os.environ | {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    done = subprocess.run(
        ["fish", "--no-config", "-c", asked],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
    names = {line.split("\t")[0] for line in done.stdout.splitlines()}
    assert {"station", "serve"} <= names
