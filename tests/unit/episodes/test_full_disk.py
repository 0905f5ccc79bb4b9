"""A full disk while a take is written: the reason is told, and nothing is left of the take."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from dextouch.errors import StorageFullError
from tests.unit.episodes.broken_takes import FORCE, NOISE, assert_nothing_left, record, take


def fill_disk(writer):
    rng = np.random.default_rng(1)
    for number in range(10_000):
        values = rng.normal(size=(1, 900)).astype("f4")
        writer.append("noise", values=values, t_host_ns=np.array([number]))


def test_a_full_disk_leaves_nothing(store, file_size_limit):
    writer = store.writer(kind="recording", attributes=take(NOISE))
    with file_size_limit(1_000_000), pytest.raises(StorageFullError) as caught, writer:
        fill_disk(writer)
    assert "array noise: no space left" in caught.value.message
    # Nothing can follow a block that was broken off.
    assert "try again" not in caught.value.message
    assert_nothing_left(store)


def test_short_writes_go_on_where_they_ended(store, monkeypatch):
    short: list[int] = []

    def writev(file, views):
        short.append(os.write(file, bytes(views[0])[:7]))
        return short[-1]

    monkeypatch.setattr(os, "writev", writev)
    with store.writer(kind="recording", attributes=take(FORCE)) as writer:
        record(writer, 0, 17)
    reader = store.recording("take-1")
    reader.verify()
    assert reader.read("force").t_host_ns.tolist() == list(range(17))
    assert max(short) == 7
    assert len(short) > 17


FULL_DISK = """
import json
import sys
from pathlib import Path
import numpy as np
from dextouch.episodes import EpisodeStore
from dextouch.errors import StorageFullError
from dextouch.schemas.episodes import RecordingAttributes

disk = Path(sys.argv[1])
store = EpisodeStore(disk / "store")
attributes = RecordingAttributes.model_validate_json(sys.argv[2])
rng, num_appended, told = np.random.default_rng(1), 0, ""
try:
    with store.writer(kind="recording", attributes=attributes) as writer:
        while True:
            values = rng.normal(size=(1, 900)).astype("f4")
            writer.append("noise", values=values, t_host_ns=np.array([num_appended]))
            num_appended += 1
except StorageFullError as error:
    told = error.message
left = [path.name for path in (disk / "store" / ".staging").iterdir()]
# There is space again.
with store.writer(kind="recording", attributes=attributes) as writer:
    writer.append("noise", values=np.ones((90, 900), "f4"), t_host_ns=np.arange(90))
store.recording("take-1").verify()
print(json.dumps({"appended": num_appended, "told": told, "left": left}))
"""


@pytest.mark.long
@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare to mount a small disk with")
def test_a_disk_that_is_really_full(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = 'mount -t tmpfs -o size=4m none "$1" || exit 77; shift; exec "$@"'
    small_disk = ["unshare", "-rm", "sh", "-c", mounted, "sh", str(disk)]
    script = [sys.executable, "-c", FULL_DISK, str(disk), take(NOISE).model_dump_json()]
    child = subprocess.run(
        [*small_disk, *script],
        capture_output=True,
        text=True,
        check=False,
    )
    if child.returncode == 77 or child.stderr.startswith("unshare"):
        pytest.skip(f"no small disk can be mounted here: {child.stderr.strip()}")
    assert child.returncode == 0, child.stderr
    got = json.loads(child.stdout)
    assert "no space left" in got["told"]
    assert got["appended"] > 600
    assert got["left"] == []
