"""Worker processes that share devices: each gets its own, also after one was replaced."""

import os
import subprocess
import sys

import pytest

from dextouch.errors import UnavailableError
from services.world_model.devices import claimed_device

CLAIM = """
import sys
from pathlib import Path
from services.world_model.devices import claimed_device
print(claimed_device(sys.argv[2], Path(sys.argv[1])), flush=True)
sys.stdin.read()
"""


def started(folder, names="cpu, cpu:0"):
    process = subprocess.Popen(
        [sys.executable, "-c", CLAIM, str(folder), names],
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


def test_lists_may_differ_and_a_process_claims_once(tmp_path):
    longer, a = started(tmp_path, "cpu:2, cpu:0, cpu")
    assert a == "cpu:2"
    other, b = started(tmp_path, "cpu:2, cpu")
    assert b == "cpu"
    # This process holds one of them, however many models it opens.
    assert [claimed_device("cpu:2, cpu:3", tmp_path) for _ in range(3)] == ["cpu:3"] * 3
    assert len(list(tmp_path.iterdir())) == 3
    for process in (longer, other):
        ended(process)
    # What dead processes held is removed by the next one.
    assert claimed_device("cpu:3, cpu:2, cpu", tmp_path) == "cpu:2"
    assert len(list(tmp_path.iterdir())) == 2


def test_folders_and_links_of_others_are_refused(tmp_path, monkeypatch):
    target = tmp_path / "target"
    target.mkdir()
    (tmp_path / "link").symlink_to(target)
    with pytest.raises(UnavailableError, match=r"link .*TMPDIR"):
        claimed_device("cpu, cpu:0", tmp_path / "link")
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.raises(UnavailableError, match=r"target of user .* of user 12345"):
        claimed_device("cpu, cpu:0", target)
    assert not any(target.iterdir())
