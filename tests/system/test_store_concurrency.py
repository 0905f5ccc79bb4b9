"""One process records, four read what it has finished meanwhile: no row is ever wrong."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.system import take_source
from tests.system.following_child import Board

CHILD = Path(__file__).with_name("following_child.py")
NUM_READERS = 4
pytestmark = pytest.mark.system


def run_together(folder, seconds):
    """What the recorder and the readers say after `seconds` of recording."""
    images_path, board_path = folder / "images.npy", folder / "board"
    np.save(images_path, take_source.draw_images())
    Board(board_path, create=True)
    roles = [("record", seconds), *(("read", seed) for seed in range(NUM_READERS))]
    children = [
        subprocess.Popen(
            [
                sys.executable, str(CHILD), str(folder / "store"), str(board_path),
                str(images_path), role, str(number),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for role, number in roles
    ]  # fmt: skip
    try:
        said = [child.communicate(timeout=seconds + 240) for child in children]
    finally:
        for child in children:
            child.kill()
            child.wait()
    for child, (_, errors) in zip(children, said, strict=True):
        assert child.returncode == 0, errors[-3000:]
    recorder, *readers = [json.loads(out) for out, _ in said]
    return recorder, readers


def check_together(folder, seconds):
    recorder, readers = run_together(folder, seconds)
    assert recorder["takes"] >= 2
    total = {name: sum(reader[name] for reader in readers) for name in readers[0]}
    for reader in readers:
        assert reader["rows"] > 0, readers
    assert total["recordings"] > 0
    assert total["windows"] > 0
    # Reading what is just deleted fails in the open, and is not what readers mostly do.
    assert total["gone"] < 0.2 * (total["recordings"] + total["windows"]), total
    return {**recorder, **total}


def test_readers_beside_a_recorder(tmp_path):
    check_together(tmp_path, 6.0)


@pytest.mark.slow
def test_readers_beside_a_recorder_for_5_minutes(tmp_path, capsys):
    found = check_together(tmp_path, 300.0)
    with capsys.disabled():
        sys.stdout.write(f"\none recorder and {NUM_READERS} readers: {found}\n")
