"""What a full disk leaves of a take: everything that was recorded before."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from dextouch.errors import (
    StorageFullError,
)
from tests.unit.episodes.broken_takes import (
    NOISE,
    take,
)


def fill_disk(writer):
    rng = np.random.default_rng(1)
    for number in range(10_000):
        values = rng.normal(size=(1, 900)).astype("f4")
        writer.append("noise", values=values, t_host_ns=np.array([number]))


def test_a_full_disk_keeps_the_take(store, file_size_limit):
    writer = store.writer(kind="recording", attributes=take(NOISE))
    with file_size_limit(1_000_000), pytest.raises(StorageFullError) as caught, writer:
        fill_disk(writer)
    assert "no space left" in caught.value.message
    # Nothing can follow a block that was broken off.
    assert "try again" not in caught.value.message
    # Cutting off the storage chunk that did not fit left room for the index.
    assert "marked as recovered" in " ".join(caught.value.__notes__)
    reader = store.recording("take-1")
    reader.verify()
    assert reader.num_samples("noise") >= 240
    expected = np.random.default_rng(1).normal(size=(reader.num_samples("noise"), 900))
    np.testing.assert_array_equal(reader.read("noise").values, expected.astype("f4"))


FULL_DISK = """
import json
import sys
from pathlib import Path
import numpy as np
from dextouch.episodes import EpisodeStore
from dextouch.errors import StorageFullError
from dextouch.schemas.recordings import RecordingAttributes

disk = Path(sys.argv[1])
ballast = disk / "ballast"
ballast.write_bytes(bytes(1 << 20))
store = EpisodeStore(disk / "store")
rng, num_appended, notes = np.random.default_rng(1), 0, []
try:
    attributes = RecordingAttributes.model_validate_json(sys.argv[2])
    with store.writer(kind="recording", attributes=attributes) as writer:
        while True:
            values = rng.normal(size=(1, 900)).astype("f4")
            writer.append("noise", values=values, t_host_ns=np.array([num_appended]))
            num_appended += 1
except StorageFullError as error:
    notes = getattr(error, "__notes__", [])
before = store.list(kind="recording")
ballast.unlink()
(group,) = store.recover()
store.recording("take-1").verify()
answer = {"appended": num_appended, "notes": notes, "before": before, "kept": group.num_samples}
print(json.dumps(answer))
"""


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
    assert got["before"] == []
    assert "EpisodeStore.recover completes it" in " ".join(got["notes"])
    assert got["appended"] > 600
    assert got["appended"] - got["kept"]["noise"] <= 30
