"""Worker processes that share devices: each gets its own, also after one was replaced."""

import subprocess
import sys

from services.world_model.devices import claimed_device

CLAIM = """
import sys
from pathlib import Path
from services.world_model.devices import claimed_device
print(claimed_device("cpu, cpu:0", Path(sys.argv[1])), flush=True)
sys.stdin.read()
"""


def started(folder):
    process = subprocess.Popen(
        [sys.executable, "-c", CLAIM, str(folder)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    return process, process.stdout.readline().strip()


def ended(process):
    process.communicate()


def test_every_process_holds_the_device_with_the_fewest(tmp_path):
    first, a = started(tmp_path)
    second, b = started(tmp_path)
    assert [a, b] == ["cpu", "cpu:0"]
    # A worker that died is replaced on its device.
    ended(second)
    second, b = started(tmp_path)
    assert b == "cpu:0"
    # One after another: the successor of the oldest starts while it still holds its device.
    third, c = started(tmp_path)
    ended(first)
    fourth, d = started(tmp_path)
    ended(second)
    assert sorted([c, d]) == ["cpu", "cpu:0"]
    for process in (third, fourth):
        ended(process)


def test_a_single_device_needs_no_claim(tmp_path):
    assert claimed_device("cuda", tmp_path) == "cuda"
    assert not any(tmp_path.iterdir())
