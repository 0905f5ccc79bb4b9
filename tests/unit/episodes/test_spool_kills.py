"""The spool of a process that is killed: what it acknowledged is there."""

import random
import subprocess
import sys
from pathlib import Path

import pytest

from dextouch.episodes import spool
from tests.unit.episodes.spooled_batches import ATTRIBUTES, assert_same, glove_batch, recover

CHILD = """
import sys
from pathlib import Path
import numpy as np
from dextouch.episodes.spool import SpoolWriter
from dextouch.schemas.episodes import RecordingAttributes
from dextouch.streams.samples import SampleBatch

attributes = RecordingAttributes.model_validate_json(sys.argv[2])
writer = SpoolWriter(Path(sys.argv[1]), attributes)
for number in range(100_000):
    k = np.array([number])
    values = (k[:, None] + np.arange(360)).astype("<u2")
    writer.append("glove_left", SampleBatch(k * 16_666_667, k * 1000, k, values))
    if number % 10 == 0:
        writer.flush()
    sys.stdout.write(f"{number}\\n")
    sys.stdout.flush()
"""


def kill_in_the_middle(path, num_lines):
    """Acknowledged samples of a child that was killed after at least `num_lines` of them."""
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), ATTRIBUTES.model_dump_json()],
        stdout=subprocess.PIPE,
    )
    for _ in range(num_lines):
        child.stdout.readline()
    child.kill()
    rest = child.stdout.read().splitlines(keepends=True)
    child.stdout.close()
    child.wait()
    return num_lines + sum(line.endswith(b"\n") for line in rest)


def check_kills(folder: Path, count: int, seed: int):
    rng = random.Random(seed)
    for trial in range(count):
        path = folder / f"take-{trial}"
        acknowledged = kill_in_the_middle(path, rng.randint(1, 200))
        count = recover(path).num_samples["glove_left"]
        assert acknowledged <= count <= acknowledged + 1
        got = spool.SpoolReader(path).read("glove_left")
        assert_same(got, glove_batch(0, count))


@pytest.mark.long
def test_a_killed_process_loses_nothing_acknowledged(tmp_path):
    check_kills(tmp_path, 5, seed=1)


@pytest.mark.slow
def test_a_killed_process_loses_nothing_acknowledged_50_times(tmp_path):
    check_kills(tmp_path, 50, seed=2)
