"""kill -9 while recording: every acknowledged sample is there, and the store gets it once."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader
from services.acquisition.uploader import Uploader, recover_spool
from services.episode_store.app import create_app
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.worlds.running import served

CHILD = Path(__file__).with_name("recording_child.py")
pytestmark = pytest.mark.system


def record_and_kill(spool_root, seed, min_samples):
    """Kill the station once every stream has some samples; what it had acknowledged by then."""
    command = [sys.executable, str(CHILD), str(spool_root), str(seed)]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    acknowledged = {}
    log = []
    for line in child.stdout:
        log.append(line)
        pairs = [word.split("=") for word in line.split() if "=" in word]
        if pairs and all(count.isdigit() for _, count in pairs):
            acknowledged = {name: int(count) for name, count in pairs}
            if min(acknowledged.values()) >= min_samples:
                break
    os.kill(child.pid, signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL, "".join(log[-20:])
    child.stdout.close()
    assert acknowledged, "".join(log[-20:])
    return acknowledged


class Interrupted(EpisodeStoreClient):
    """A client that sends every batch twice."""

    def send_batch(self, recording_id, descriptor, batch, *, number):
        first = super().send_batch(recording_id, descriptor, batch, number=number)
        second = super().send_batch(recording_id, descriptor, batch, number=number)
        assert (first.replayed, second.replayed) == (False, True)
        return second


@pytest.mark.parametrize(("seed", "min_samples"), [(1, 1), (2, 20)])
def test_kill_minus_nine(tmp_path, seed, min_samples):
    spool_root, take = tmp_path / "spool", f"take-{seed}"
    acknowledged = record_and_kill(spool_root, seed, min_samples)
    assert recover_spool(spool_root) == [take]
    spool = SpoolReader(spool_root / take)
    for name, count in acknowledged.items():
        assert spool.num_samples(name) >= count
        assert np.all(np.diff(spool.read(name).sequence) > 0)

    settings = EpisodeStoreSettings(store_url=str(tmp_path / "store"), sync_uploads=False)
    with served(create_app(settings)) as url, Interrupted(url) as client:
        uploader = Uploader(spool_root, client, period_s=1.0)
        assert uploader.upload_all() == [take]
        assert uploader.upload_all() == []
        assert [r.recording_id for r in client.recordings().recordings] == [take]
    recording = EpisodeStore(settings.store_url).recording(take)
    assert {entry.event for entry in recording.attributes.ledger} == {"interrupted"}
    for name in spool.streams:
        np.testing.assert_array_equal(
            recording.read(name).sequence, spool.read(name).sequence, err_msg=name
        )
