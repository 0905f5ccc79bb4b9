"""Commands whose output nobody reads, cannot be written, or was closed by the caller."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dextouch.episodes import EpisodeStore
from tests.unit.episode_store.episodes import write_episode

COMMANDS = (
    "--help",
    "--version",
    "store list --help",
    "up --help",
    "doctor",
    "doctor --json -",
    "store list --store store --json -",
    "store show --store store e-1",
    "config example",
)


@pytest.fixture(autouse=True, params=["", "1"], ids=["buffered", "unbuffered"])
def _buffering(request, monkeypatch):
    monkeypatch.setenv("PYTHONUNBUFFERED", request.param)


def run(folder, words, **streams):
    command = [sys.executable, "-m", "services.cli.main", *words.split()]
    given = {"stdin": subprocess.DEVNULL, "stderr": subprocess.PIPE} | streams
    return subprocess.run(command, cwd=folder, text=True, check=False, timeout=300, **given)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work")
    write_episode(EpisodeStore(folder / "store"), "e-1")
    return folder


@pytest.mark.long
@pytest.mark.parametrize("words", COMMANDS)
def test_a_pipe_that_nobody_reads_ends_a_command_as_sigpipe_does(folder, words):
    reading, writing = os.pipe()
    os.close(reading)
    done = run(folder, words, stdout=writing)
    os.close(writing)
    # 128 + 13, as bash tells of `yes | true`.
    assert done.returncode == 141
    assert done.stderr.splitlines() == [
        line for line in done.stderr.splitlines() if "Traceback" not in line and "Error" not in line
    ]


@pytest.mark.long
@pytest.mark.parametrize("words", ["doctor", "--version", "store list --store store"])
def test_messages_that_nobody_reads_leave_no_traceback_either(folder, words):
    reading, writing = os.pipe()
    os.close(reading)
    done = run(folder, words, stdout=writing, stderr=writing)
    os.close(writing)
    assert done.returncode == 141


@pytest.mark.long
@pytest.mark.parametrize("words", ["doctor", "--version", "store list --store store --json -"])
def test_a_full_disk_is_one_message(folder, words):
    with Path("/dev/full").open("w") as full:
        done = run(folder, words, stdout=full)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.endswith("standard output cannot be written: No space left on device")
    assert "Traceback" not in done.stderr


def closed(*numbers):
    def close():
        for number in numbers:
            os.close(number)

    return close


@pytest.mark.long
@pytest.mark.parametrize("words", ["doctor", "store list --store store", "store list --help"])
def test_output_that_was_closed_from_the_start_is_one_message(folder, words):
    done = run(folder, words, preexec_fn=closed(1))
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith("cannot be written: Bad file descriptor")
    assert "Traceback" not in done.stderr


@pytest.mark.long
def test_a_command_that_prints_nothing_needs_no_output(folder):
    words = "config example --output example.toml"
    assert run(folder, words, preexec_fn=closed(0, 1)).returncode == 0
    # What was written went to the file, and not to the descriptor that was free.
    text = (folder / "example.toml").read_text()
    (folder / "example.toml").unlink()
    assert text.startswith("# Settings of DexTouch.")
