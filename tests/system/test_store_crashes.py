"""kill -9 of a writer at any moment: what was saved stays, what was in flight is not there."""

import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader
from tests.system import take_source
from tests.system.crash_child import (
    FLIGHT,
    SAVED,
    SAVED_SECONDS,
    SPOOL_BLOCK,
    Counters,
)
from tests.system.take_source import STREAM_NAMES
from tests.unit.episodes.spooled_batches import recover

CHILD = Path(__file__).with_name("crash_child.py")
SEED = 7
pytestmark = pytest.mark.system


class Victims:
    """Orders for the process that forks the victims, and the kills."""

    def __init__(self, images_path):
        self._process = subprocess.Popen(
            [sys.executable, str(CHILD), str(images_path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._expect("ready")

    def run(self, *, kill_after_s=None, **order):
        """Let one run until it kills itself, is done, or `kill_after_s` of recording are over."""
        self._process.stdin.write(json.dumps(order).encode() + b"\n")
        self._process.stdin.flush()
        pid = int(self._expect("recording")[1])
        out = self._process.stdout
        if kill_after_s is not None:
            # It says nothing more while it records.
            assert not select.select([out], [], [], kill_after_s)[0], out.readline()
            os.kill(pid, signal.SIGKILL)
        words = self._expect("ended", "done")
        if words[0] == "done":
            os.kill(pid, signal.SIGKILL)
            self._expect("ended")
        return words[0] == "done"

    def close(self):
        self._process.stdin.close()
        self._process.stdout.close()
        assert self._process.wait(timeout=60) == 0

    def _expect(self, *first_words):
        words = self._process.stdout.readline().decode().split()
        assert words, "the process that forks is gone"
        assert words[0] in first_words, words
        if words[0] == "ended":
            assert int(words[1]) == -signal.SIGKILL
        return words


@pytest.fixture(scope="module")
def images():
    return take_source.draw_images()


@pytest.fixture(scope="module")
def expected(images):
    return take_source.Expected(images)


@pytest.fixture(scope="module")
def victims(images, tmp_path_factory):
    path = tmp_path_factory.mktemp("images") / "images.npy"
    np.save(path, images)
    made = Victims(path)
    yield made
    made.close()


@pytest.fixture
def counters_path(tmp_path):
    return tmp_path / "counters"


def check_saved(store, expected):
    assert set(SAVED) <= set(store.list(kind="recording"))
    for seed, recording_id in enumerate(SAVED):
        reader = store.recording(recording_id)
        assert not reader.attributes.recovered
        reader.verify()
        for name in STREAM_NAMES:
            count = sum(stream == name for _, stream, _ in take_source.schedule(SAVED_SECONDS))
            assert reader.num_samples(name) == count
            expected.check(reader, name, seed, 0, count)


def check_flight(store, counters, expected, *, may_be_whole=False):
    """The take is there whole or not at all, and after a sweep nothing else is; whether it is.

    A take that `may_be_whole` can have been committed before the kill.
    """
    store.sweep()
    assert store.sweep() == 0
    assert list((store.root / ".staging").iterdir()) == []
    if not store.exists(FLIGHT, kind="recording"):
        return False
    assert may_be_whole
    reader = store.recording(FLIGHT)
    reader.verify()
    assert not reader.attributes.recovered
    for name in STREAM_NAMES:
        assert reader.num_samples(name) == counters.get(name)
        expected.check(reader, name, SEED, 0, counters.get(name))
    return True


def kill_live(victims, root, counters_path, expected, delay_s):
    counters = Counters(counters_path, create=True)
    victims.run(
        mode="live", root=str(root), counters=str(counters_path), seed=SEED,
        seconds=60.0, kill_after_s=delay_s,
    )  # fmt: skip
    store = EpisodeStore(root)
    check_saved(store, expected)
    assert not check_flight(store, counters, expected)


def test_a_killed_writer_leaves_nothing_and_bends_nothing(
    victims, tmp_path, counters_path, expected
):
    rng = random.Random(1)
    for trial, delay_s in enumerate((0.02, rng.uniform(0.4, 0.8), rng.uniform(0.8, 1.2))):
        kill_live(victims, tmp_path / str(trial), counters_path, expected, delay_s)


@pytest.mark.slow
def test_a_killed_writer_leaves_nothing_and_bends_nothing_50_times(
    victims, tmp_path, counters_path, expected
):
    rng = random.Random(2)
    for trial in range(50):
        delay_s = rng.uniform(0.0, 1.3)
        kill_live(victims, tmp_path / str(trial), counters_path, expected, delay_s)


def commit_order(root, counters_path, kill_at):
    return {
        "mode": "commit", "root": str(root), "counters": str(counters_path), "seed": SEED,
        "seconds": 0.9, "kill_at": kill_at,
    }  # fmt: skip


def check_commit_kills(victims, folder, counters_path, expected, *, num_trials, seed):
    counters = Counters(counters_path, create=True)
    assert victims.run(**commit_order(folder / "whole", counters_path, -1))
    last = counters.file_events - 1
    assert last > 4 * len(STREAM_NAMES)
    kept = []
    for kill_at in [*sorted(random.Random(seed).sample(range(last), num_trials)), last]:
        counters = Counters(counters_path, create=True)
        root = folder / str(kill_at)
        assert not victims.run(**commit_order(root, counters_path, kill_at))
        store = EpisodeStore(root)
        check_saved(store, expected)
        kept.append(check_flight(store, counters, expected, may_be_whole=True))
    # Early kills do not find the take in its place, the last one does.
    assert not kept[0]
    assert kept[-1]


def test_a_kill_while_a_take_is_committed(victims, tmp_path, counters_path, expected):
    check_commit_kills(victims, tmp_path, counters_path, expected, num_trials=2, seed=5)


@pytest.mark.slow
def test_50_kills_while_a_take_is_committed(victims, tmp_path, counters_path, expected):
    check_commit_kills(victims, tmp_path, counters_path, expected, num_trials=49, seed=6)


def check_sweep_kills(victims, folder, counters_path, expected, *, num_trials, seed):
    """Kill the sweep of a take whose writer was killed at some place of its commit."""
    rng = random.Random(seed)
    first = Counters(counters_path, create=True)
    victims.run(**commit_order(folder / "whole", counters_path, -1))
    num_events, events_path = first.file_events, folder / "events"
    for trial in range(num_trials):
        taken = Counters(counters_path, create=True)
        root, copy = folder / f"left-{trial}", folder / f"copy-{trial}"
        # Before the take is moved into its place, which is among the last events.
        kill_at = int(rng.uniform(0.0, 0.8) * num_events)
        assert not victims.run(**commit_order(root, counters_path, kill_at))
        shutil.copytree(root, copy)
        events = Counters(events_path, create=True)
        order = {"mode": "sweep", "counters": str(events_path), "seed": SEED}
        assert victims.run(**order, root=str(copy), kill_at=-1)
        kill_at = rng.randrange(events.file_events)
        Counters(events_path, create=True)
        assert not victims.run(**order, root=str(root), kill_at=kill_at)
        store = EpisodeStore(root)
        check_saved(store, expected)
        assert not check_flight(store, taken, expected)


def test_a_kill_of_the_sweep_itself(victims, tmp_path, counters_path, expected):
    check_sweep_kills(victims, tmp_path, counters_path, expected, num_trials=3, seed=7)


@pytest.mark.slow
def test_50_kills_of_the_sweep_itself(victims, tmp_path, counters_path, expected):
    check_sweep_kills(victims, tmp_path, counters_path, expected, num_trials=50, seed=8)


def kill_spool(victims, root, counters_path, jpegs, delay_s):
    counters = Counters(counters_path, create=True)
    victims.run(
        mode="spool", root=str(root), counters=str(counters_path), seed=SEED,
        seconds=60.0, kill_after_s=delay_s,
    )  # fmt: skip
    counts = recover(root / FLIGHT).num_samples
    spool = SpoolReader(root / FLIGHT)
    for name in STREAM_NAMES:
        acknowledged, count = counters.get(name), counts[name]
        # A block goes to the log in one write, so a kill does not part it either.
        assert count in {acknowledged, acknowledged + SPOOL_BLOCK}
        got, made = spool.read(name), take_source.spool_batch(name, SEED, 0, count, jpegs)
        for field in ("t_host_ns", "t_device_ns", "sequence", "values"):
            np.testing.assert_array_equal(getattr(got, field), getattr(made, field), err_msg=name)


def test_a_killed_spool_keeps_every_acknowledged_sample(victims, tmp_path, counters_path, images):
    jpegs = take_source.encode_jpegs(images)
    for trial, delay_s in enumerate((0.01, 0.4, 0.7)):
        kill_spool(victims, tmp_path / str(trial), counters_path, jpegs, delay_s)


@pytest.mark.slow
def test_a_killed_spool_keeps_every_acknowledged_sample_50_times(
    victims, tmp_path, counters_path, images
):
    rng, jpegs = random.Random(3), take_source.encode_jpegs(images)
    for trial in range(50):
        kill_spool(victims, tmp_path / str(trial), counters_path, jpegs, rng.uniform(0.0, 1.3))
