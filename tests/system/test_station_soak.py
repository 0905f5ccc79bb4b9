"""A whole station for long, with random faults and two kill -9: all that was said is in the store.

The clock is simulated, so that a take passes as fast as the processor allows.
"""

import json
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
from services.episode_store.app import create_app
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.worlds.running import served

CHILD = Path(__file__).with_name("soak_child.py")
ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.system


class Soak:
    """Runs the station until all takes are made, killing it in the middle of some."""

    def __init__(self, spool, url, *, num_takes, seconds):
        self.acknowledged = {}
        self.rss_bytes = []
        self._spool, self._url = spool, url
        self._num_takes, self._seconds = num_takes, seconds

    def run(self, first_take, seed, kill_in=None):
        """From a take on to the end, or until the kill; whether it came to its end."""
        arguments = [self._spool, self._url, seed, first_take, self._num_takes, self._seconds]
        log = self._spool.with_name(f"station-{first_take}.log")
        with log.open("w") as errors:
            child = subprocess.Popen(
                [sys.executable, str(CHILD), *map(str, arguments)],
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env={
                    **os.environ,
                    # As deployed: see docker-compose.yml and deploy/systemd.
                    "MALLOC_ARENA_MAX": "1",
                    "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'shared'}",
                },
            )
        is_done = False
        self.rss_bytes = []
        for line in child.stdout:
            fact = json.loads(line)
            is_done = is_done or fact["event"] == "done"
            if "counts" in fact:
                self.acknowledged[fact["take"]] = fact["counts"]
            if fact["event"] == "uploaded":
                self.rss_bytes.append(fact["rss_bytes"])
            elif (
                kill_in is not None
                and fact.get("take") == kill_in
                and max(fact["counts"].values()) >= 20
            ):
                os.kill(child.pid, signal.SIGKILL)
                break
        child.stdout.close()
        code = child.wait()
        assert code == (0 if kill_in is None else -signal.SIGKILL), log.read_text()[-3000:]
        return is_done


def rss_slope_mb_per_hour(rss_bytes, seconds):
    """Growth of one station by simulated time: middle slope of all pairs of takes, after warm-up.

    Windows of minutes, heaps and bounded logs fill in the first ten takes. The middle slope does
    not see the single jump of an allocator.
    """
    kept = np.array(rss_bytes[10:]) / 1e6
    first, second = np.triu_indices(len(kept), 1)
    slopes = (kept[second] - kept[first]) / ((second - first) * seconds / 3600)
    return float(np.median(slopes))


def soak(tmp_path, *, num_takes, seconds, kills):
    """All takes, with a kill in some; memory of the last process."""
    settings = EpisodeStoreSettings(store_url=str(tmp_path / "store"), sync_uploads=False)
    spool = tmp_path / "spool"
    spool.mkdir()
    with served(create_app(settings)) as url, EpisodeStoreClient(url) as client:
        station = Soak(spool, url, num_takes=num_takes, seconds=seconds)
        first = 0
        for seed, number in enumerate(kills):
            assert not station.run(first, seed, kill_in=f"take-{number:03d}")
            first = number + 1
        assert station.run(first, len(kills))
        ids = [recording.recording_id for recording in client.recordings().recordings]
    assert sorted(ids) == [f"take-{number:03d}" for number in range(num_takes)]
    store = EpisodeStore(settings.store_url)
    for recording_id, counts in station.acknowledged.items():
        spooled, recording = SpoolReader(spool / recording_id), store.recording(recording_id)
        for stream, count in counts.items():
            kept, sent = spooled.read(stream), recording.read(stream)
            assert len(sent) >= count, (recording_id, stream)
            for field in ("sequence", "t_host_ns", "t_device_ns"):
                np.testing.assert_array_equal(getattr(sent, field), getattr(kept, field))
            assert len(set(zip(sent.sequence, sent.t_device_ns, strict=True))) == len(sent)
    killed = {f"take-{number:03d}" for number in kills}
    for recording_id in killed:
        events = {entry.event for entry in store.recording(recording_id).attributes.ledger}
        assert "interrupted" in events
    return station.rss_bytes


def test_a_short_soak(tmp_path):
    assert len(soak(tmp_path, num_takes=3, seconds=1.0, kills=(0, 1))) == 1


@pytest.mark.slow
def test_half_an_hour_of_a_whole_station(tmp_path):
    # The last process is one station that lives for 24 minutes.
    rss_bytes = soak(tmp_path, num_takes=30, seconds=60.0, kills=(2, 5))
    slope = rss_slope_mb_per_hour(rss_bytes, 60.0)
    shown = " ".join(f"{size / 1e6:.1f}" for size in rss_bytes)
    print(f"RSS after each take (MB): {shown}\ngrowth {slope:.2f} MB an hour of simulated time")  # noqa: T201
    assert slope < 1.0
