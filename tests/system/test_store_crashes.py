"""kill -9 of a writer at any moment: what was saved stays, what was in flight is cut, not bent."""

import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader
from dextouch.episodes.stream_writer import MAX_WAITING_IMAGES
from tests.system import take_source
from tests.system.crash_child import (
    APPENDED,
    ENCODED,
    FLIGHT,
    SAVED,
    SAVED_SECONDS,
    SPOOL_BLOCK,
    Counters,
)
from tests.system.take_source import CAMERAS, NUMBERS, STREAM_NAMES
from tests.unit.episodes.spooled_batches import recover

CHILD = Path(__file__).with_name("crash_child.py")
SEED = 7
GOP_IMAGES = 8
FIRST_WINDOW_NS = 1_100_000_000
MAX_REOPEN_S = 1.0
pytestmark = pytest.mark.system


@dataclass(frozen=True)
class Outcome:
    """What a kill cost: samples a stream, images that waited before the encoders, seconds.

    `reopen_cpu_s` is the share of this process: others that keep the machine busy do not count.
    """

    lost: dict
    waiting: dict
    reopen_s: float
    reopen_cpu_s: float


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


def reopen(store):
    """Recover, open and read the first window; the reader, or None, and the seconds it took.

    The seconds are those of the wall and those of the processor.
    """
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    store.recover()
    reader = store.recording(FLIGHT) if store.exists(FLIGHT, kind="recording") else None
    for name in STREAM_NAMES if reader is not None else ():
        reader.read(name, take_source.START_NS, take_source.START_NS + FIRST_WINDOW_NS)
    return reader, time.perf_counter() - start_s, time.process_time() - start_cpu_s


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
    """Every row that is there is the one that was written, and few are missing at the end.

    A take that `may_be_whole` can have been committed before the kill, and lacks nothing then.
    """
    reader, reopen_s, reopen_cpu_s = reopen(store)
    assert reopen_cpu_s < MAX_REOPEN_S
    assert store.recover() == ()
    if reader is not None:
        reader.verify()
        whole = may_be_whole and not reader.attributes.recovered
        assert whole or reader.attributes.recovered
    lost, waiting = {}, {}
    for name in STREAM_NAMES:
        count = 0 if reader is None else reader.num_samples(name)
        if count:
            expected.check(reader, name, SEED, 0, count)
        appended = counters.get(APPENDED, name)
        # One more may have been written before its writer could say so.
        assert count <= appended + 1
        # Images that wait before the encoder are in memory, as those of an unfinished group are.
        done = counters.get(ENCODED, name) if name in CAMERAS else appended
        assert done - count <= take_source.chunk_rows(name)
        lost[name], waiting[name] = max(0, appended - count), max(0, appended - done)
        assert waiting[name] <= MAX_WAITING_IMAGES
        if reader is not None and whole:
            assert count == appended
    return Outcome(lost, waiting, reopen_s, reopen_cpu_s)


def kill_live(victims, root, counters_path, expected, delay_s):
    counters = Counters(counters_path, create=True)
    victims.run(
        mode="live", root=str(root), counters=str(counters_path), seed=SEED,
        seconds=60.0, kill_after_s=delay_s,
    )  # fmt: skip
    store = EpisodeStore(root)
    check_saved(store, expected)
    return check_flight(store, counters, expected)


def check_live_kills(victims, folder, counters_path, expected, delays_s):
    outcomes = [
        kill_live(victims, folder / str(trial), counters_path, expected, delay_s)
        for trial, delay_s in enumerate(delays_s)
    ]
    images = [max(o.lost[name] for name in CAMERAS) for o in outcomes]
    queued = [max(o.waiting[name] for name in CAMERAS) for o in outcomes]
    numbers_s = [
        max(o.lost[name] / take_source.RATES_HZ[name] for name in NUMBERS) for o in outcomes
    ]
    return {
        "trials": len(outcomes),
        "images lost, most": max(images),
        "of them waiting before an encoder, most": max(queued),
        "trials with more than a group lost": sum(n > GOP_IMAGES for n in images),
        "numbers lost, most s": round(max(numbers_s), 3),
        "reopen, median s": round(float(np.median([o.reopen_s for o in outcomes])), 3),
        "reopen, most s": round(max(o.reopen_s for o in outcomes), 3),
        "reopen, most processor s": round(max(o.reopen_cpu_s for o in outcomes), 3),
    }


def test_a_killed_recorder_loses_little_and_bends_nothing(
    victims, tmp_path, counters_path, expected
):
    rng = random.Random(1)
    delays_s = [0.02, rng.uniform(0.4, 0.8), rng.uniform(0.8, 1.2)]
    found = check_live_kills(victims, tmp_path, counters_path, expected, delays_s)
    assert found["numbers lost, most s"] <= 0.5


@pytest.mark.slow
def test_a_killed_recorder_loses_little_and_bends_nothing_50_times(
    victims, tmp_path, counters_path, expected, capsys
):
    rng = random.Random(2)
    delays_s = [rng.uniform(0.0, 1.3) for _ in range(50)]
    found = check_live_kills(victims, tmp_path, counters_path, expected, delays_s)
    assert found["numbers lost, most s"] <= 0.5
    assert found["reopen, median s"] < MAX_REOPEN_S
    with capsys.disabled():
        sys.stdout.write(f"\nkills at random moments: {found}\n")


def commit_order(root, counters_path, kill_at):
    return {
        "mode": "commit", "root": str(root), "counters": str(counters_path), "seed": SEED,
        "seconds": 0.9, "kill_at": kill_at,
    }  # fmt: skip


def check_commit_kills(victims, folder, counters_path, expected, *, num_trials, seed):
    counters = Counters(counters_path, create=True)
    assert victims.run(**commit_order(folder / "whole", counters_path, -1))
    num_events = counters.file_events
    assert num_events > 20 * len(STREAM_NAMES)
    kept = []
    for kill_at in sorted(random.Random(seed).sample(range(num_events), num_trials)):
        counters = Counters(counters_path, create=True)
        root = folder / str(kill_at)
        assert not victims.run(**commit_order(root, counters_path, kill_at))
        store = EpisodeStore(root)
        check_saved(store, expected)
        outcome = check_flight(store, counters, expected, may_be_whole=True)
        kept.append(sum(outcome.lost.values()))
        assert store.sweep() == 0
    return kept


def test_a_kill_while_a_take_is_committed(victims, tmp_path, counters_path, expected):
    check_commit_kills(victims, tmp_path, counters_path, expected, num_trials=3, seed=5)


@pytest.mark.slow
def test_50_kills_while_a_take_is_committed(victims, tmp_path, counters_path, expected):
    kept = check_commit_kills(victims, tmp_path, counters_path, expected, num_trials=50, seed=6)
    # Late kills find everything on the disk, early ones do not: both kinds were met.
    assert min(kept) == 0
    assert max(kept) > 0


def check_recovery_kills(victims, folder, counters_path, expected, *, num_trials, seed):
    """Kill the recovery of a take whose writer was killed at another place of its commit."""
    rng = random.Random(seed)
    first = Counters(counters_path, create=True)
    victims.run(**commit_order(folder / "whole", counters_path, -1))
    num_events, events_path = first.file_events, folder / "events"
    for trial in range(num_trials):
        # Every third towards the end, when arrays are shards and have their metadata.
        low = 0.75 if trial % 3 == 0 else 0.0
        taken = Counters(counters_path, create=True)
        root, copy = folder / f"left-{trial}", folder / f"copy-{trial}"
        kill_at = int(rng.uniform(low, 1.0) * num_events)
        assert not victims.run(**commit_order(root, counters_path, kill_at))
        shutil.copytree(root, copy)
        events = Counters(events_path, create=True)
        order = {"mode": "recover", "counters": str(events_path), "seed": SEED}
        assert victims.run(**order, root=str(copy), kill_at=-1)
        kill_at = rng.randrange(events.file_events)
        Counters(events_path, create=True)
        assert not victims.run(**order, root=str(root), kill_at=kill_at)
        check_flight(EpisodeStore(root), taken, expected, may_be_whole=True)


def test_a_kill_of_the_recovery_itself(victims, tmp_path, counters_path, expected):
    check_recovery_kills(victims, tmp_path, counters_path, expected, num_trials=3, seed=7)


class KilledHereError(Exception):
    """Stands for a kill."""


def test_a_recovery_that_died_with_a_shard_back_in_the_log(
    victims, tmp_path, counters_path, expected, monkeypatch
):
    def killed(*_arguments, **_options):
        raise KilledHereError

    counters = Counters(counters_path, create=True)
    victims.run(**commit_order(tmp_path / "whole", counters_path, -1))
    # When all arrays are shards and most have their metadata, before the commit record.
    late = int(0.82 * counters.file_events)
    counters = Counters(counters_path, create=True)
    assert not victims.run(**commit_order(tmp_path / "store", counters_path, late))
    store = EpisodeStore(tmp_path / "store")
    with monkeypatch.context() as patch:
        patch.setattr("dextouch.episodes.staging_recovery.shutil.rmtree", killed)
        with pytest.raises(KilledHereError):
            store.recover()
    check_flight(store, counters, expected)


@pytest.mark.slow
def test_50_kills_of_the_recovery_itself(victims, tmp_path, counters_path, expected):
    check_recovery_kills(victims, tmp_path, counters_path, expected, num_trials=50, seed=8)


def kill_spool(victims, root, counters_path, jpegs, delay_s):
    counters = Counters(counters_path, create=True)
    victims.run(
        mode="spool", root=str(root), counters=str(counters_path), seed=SEED,
        seconds=60.0, kill_after_s=delay_s,
    )  # fmt: skip
    counts = recover(root / FLIGHT).num_samples
    spool = SpoolReader(root / FLIGHT)
    for name in STREAM_NAMES:
        acknowledged, count = counters.get(APPENDED, name), counts[name]
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
