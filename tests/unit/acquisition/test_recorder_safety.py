"""What a take survives: power loss, a full disk, a sleeping host, a wall clock that is set."""

import errno
import os
import resource
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from pydantic import ValidationError

from dextouch.episodes.spool import SpoolReader
from dextouch.errors import StorageFullError
from dextouch.schemas import SaveTake, TakePrompt
from dextouch.streams import Sample
from services.acquisition import take
from services.acquisition.clock import StationClock
from services.acquisition.devices.pose_tracker import PoseTrackerDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.mocks.ports import HidPort
from services.acquisition.recorder import Recorder
from services.acquisition.settings import SpoolSafety
from tests.unit.acquisition.sleepy_clock import SleepyClock

PROMPT = TakePrompt(task="stand_bottle", instruction="stand the bottle up")
ANYWAY = SaveTake(accept_incomplete=True)
POSE = np.array([0.0, 0, 0, 1, 0, 0, 0])


@contextmanager
def file_size_limit(num_bytes):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def clock():
    return SleepyClock(10**9)


@pytest.fixture
def make_recorder(tmp_path, clock):
    made = []

    def make(**safety):
        port, decoder = HidPort("b"), PoseTrackerDecoder("head")
        driver = Driver("pose_tracker_head", transport=port.transport, decoder=decoder, clock=clock)
        recorder = Recorder(
            station="test",
            spool_root=tmp_path,
            drivers=[driver],
            clock=clock,
            calibration={},
            safety=SpoolSafety(**safety),
        )
        made.append(recorder)
        return recorder

    yield make
    for recorder in made:
        recorder.close()


def advance(clock, duration_ns):
    waiter = clock.waiter(drives_time=True)
    waiter.wait_until(clock.now_ns() + duration_ns)
    waiter.close()


def play(recorder, clock, num_samples, first=0):
    for index in range(first, first + num_samples):
        recorder.take.accept({"head": [Sample(clock.now_ns(), POSE, 5, index)]})
        advance(clock, 10_000_000)


@pytest.mark.parametrize(("period_s", "flushes"), [(0.5, 4), (0.1, 20)])
def test_the_log_reaches_the_disk_again_and_again(
    make_recorder, clock, monkeypatch, period_s, flushes
):
    synced_bytes = []
    fdatasync = os.fdatasync

    def watch(descriptor):
        fdatasync(descriptor)
        synced_bytes.append(os.fstat(descriptor).st_size)

    recorder = make_recorder(flush_period_s=period_s)
    recorder.arm(PROMPT)
    recorder.record("take")
    monkeypatch.setattr(take.os, "fdatasync", watch)
    play(recorder, clock, 205)
    running = len(synced_bytes)
    assert running == flushes
    assert np.all(np.diff(synced_bytes) > 0)
    recorder.stop()
    # The stop itself leaves nothing that a power loss could take.
    assert len(synced_bytes) == running + 1
    assert synced_bytes[-1] == (recorder.spool_root / "take" / "batches.log").stat().st_size


def test_readers_do_not_wait_for_the_disk(make_recorder, clock, monkeypatch):
    stuck, release = threading.Event(), threading.Event()

    def hang(_):
        stuck.set()
        assert release.wait(20)

    recorder = make_recorder(flush_period_s=0.1)
    recorder.arm(PROMPT)
    recorder.record("take")
    monkeypatch.setattr(take.os, "fdatasync", hang)
    waiter = clock.waiter(drives_time=True)
    mover = threading.Thread(target=waiter.wait_until, args=(clock.now_ns() + 10**9,))
    mover.start()
    assert stuck.wait(20)
    for index in range(50):
        recorder.take.accept({"head": [Sample(clock.now_ns(), POSE, 5, index)]})
    assert recorder.status().num_samples == {"head": 50}
    assert SpoolReader(recorder.spool_root / "take").num_samples("head") == 50
    monkeypatch.undo()
    release.set()
    mover.join()
    waiter.close()
    assert recorder.stop().num_samples == {"head": 50}


def test_a_disk_that_cannot_flush_ends_the_take(make_recorder, clock, monkeypatch):
    def broken(_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    recorder = make_recorder(flush_period_s=0.1)
    recorder.arm(PROMPT)
    recorder.record("take")
    play(recorder, clock, 5)
    monkeypatch.setattr(take.os, "fdatasync", broken)
    play(recorder, clock, 30, first=5)
    monkeypatch.undo()
    status = recorder.status()
    assert status.state == "checking"
    assert "flush spool 'take'" in status.problems[0]
    assert "error" in status.problems[0]
    assert "Free space" not in status.check.cause.advice
    assert recorder.save(ANYWAY).state == "saved"
    # How many came in before the flushing thread had its turn depends on the machine.
    assert 10 <= SpoolReader(recorder.spool_root / "take").num_samples("head") < 35


def test_a_full_disk_ends_the_take_and_it_can_be_saved(make_recorder, clock):
    recorder = make_recorder()
    recorder.arm(PROMPT)
    recorder.record("take")
    with file_size_limit(20_000):
        play(recorder, clock, 400)
        status = recorder.status()
        assert status.state == "checking"
        assert "no space left" in status.problems[0]
        assert status.check.cause.advice.startswith("Free space")
        saved = recorder.save(ANYWAY)
    spool = SpoolReader(recorder.spool_root / "take")
    assert spool.closed
    kept = spool.read("head").sequence
    np.testing.assert_array_equal(kept, np.arange(len(kept)))
    assert 50 < len(kept) == saved.num_samples["head"] < 400


def test_a_nearly_full_disk_ends_the_take_before_anything_is_lost(
    make_recorder, clock, monkeypatch
):
    recorder = make_recorder(min_free_bytes=1 << 20, flush_period_s=0.1)
    recorder.arm(PROMPT)
    recorder.record("take")
    play(recorder, clock, 15)
    statvfs = os.statvfs

    def nearly_full(path):
        found = list(statvfs(path))
        found[4] = (1 << 20) // found[1] - 1  # f_bavail
        return os.statvfs_result(found)

    monkeypatch.setattr(take.os, "statvfs", nearly_full)
    play(recorder, clock, 30, first=15)
    status = recorder.status()
    assert status.state == "checking"
    assert "no space left to continue" in status.problems[0]
    assert recorder.save(ANYWAY).state == "saved"
    assert SpoolReader(recorder.spool_root / "take").num_samples("head") >= 15
    recorder.arm(PROMPT)
    with pytest.raises(StorageFullError, match="free space before the next take"):
        recorder.record("next")
    assert recorder.status().state == "armed"
    monkeypatch.undo()
    assert recorder.record("next").state == "recording"


def test_a_sleeping_host_leaves_a_gap_that_is_named(make_recorder, clock):
    recorder = make_recorder()
    recorder.arm(PROMPT)
    recorder.record("take")
    play(recorder, clock, 100)
    clock.suspend(12 * 10**9)
    play(recorder, clock, 100, first=100)
    status = recorder.stop()
    assert "the host was suspended for 12.0 s" in status.problems[0]
    assert ("gap", "ERROR") in {(p.code, p.level) for p in status.check.problems}
    recorder.save(ANYWAY)
    spool = SpoolReader(recorder.spool_root / "take")
    assert spool.num_samples("head") == 200
    assert np.diff(spool.read("head").t_host_ns).max() == pytest.approx(12.01e9)
    entries = {e.event: e for e in spool.attributes.ledger}
    assert entries["host_suspended"].count == 1
    assert entries["host_suspended"].first_t_host_ns >= 13 * 10**9


def test_a_step_of_the_wall_clock_moves_no_stamp(make_recorder, clock, monkeypatch):
    recorder = make_recorder()
    recorder.arm(PROMPT)
    recorder.record("take")
    play(recorder, clock, 100)
    monkeypatch.setattr(clock, "wall_offset_ns", lambda: -3600 * 10**9)
    play(recorder, clock, 100, first=100)
    status = recorder.stop()
    assert status.check.complete
    assert "wall clock was set by 3600.0 s" in status.problems[0]
    recorder.save(SaveTake())
    spool = SpoolReader(recorder.spool_root / "take")
    assert set(np.diff(spool.read("head").t_host_ns)) == {10_000_000}
    assert {(e.event, e.count) for e in spool.attributes.ledger} == {("wall_clock_set", 1)}


def test_the_real_clock_tells_of_sleep_and_settings(monkeypatch):
    import time

    raw, boot, mono, wall = (
        time.CLOCK_MONOTONIC_RAW,
        time.CLOCK_BOOTTIME,
        time.CLOCK_MONOTONIC,
        time.CLOCK_REALTIME,
    )
    shown = {raw: 29 * 10**9, boot: 50 * 10**9, mono: 30 * 10**9, wall: 10**18}
    monkeypatch.setattr(time, "clock_gettime_ns", shown.__getitem__)
    clock = StationClock()
    offset_ns = clock.wall_offset_ns()
    assert (clock.now_ns(), clock.suspended_ns()) == (49 * 10**9, 20 * 10**9)
    # Asleep for 6 s of 7.
    for name, passed_s in {raw: 1, boot: 7, mono: 1, wall: 7}.items():
        shown[name] += passed_s * 10**9
    assert (clock.now_ns(), clock.suspended_ns()) == (56 * 10**9, 26 * 10**9)
    assert clock.wall_offset_ns() == offset_ns
    # NTP slews all but the raw clock; a reading between the two of a difference came late.
    for name in (boot, mono, wall):
        shown[name] += 50_000_000
    shown[mono] += 3_000
    assert (clock.now_ns(), clock.suspended_ns()) == (56 * 10**9, 26 * 10**9)
    assert clock.wall_offset_ns() == offset_ns
    shown[wall] += 3 * 10**9
    assert clock.wall_offset_ns() == offset_ns + 3 * 10**9
    assert clock.now_ns() == 56 * 10**9


@pytest.mark.parametrize("wrong", [{"flush_period_s": 0.0}, {"min_free_bytes": -1}])
def test_impossible_safety_is_refused(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        SpoolSafety(**wrong)


@pytest.mark.long
def test_an_incomplete_take_keeps_that_and_the_cause(make_recorder, clock):
    recorder = make_recorder()
    for name, is_complete in (("whole", True), ("torn", False)):
        recorder.arm(PROMPT)
        recorder.record(name)
        play(recorder, clock, 150)
        if not is_complete:
            advance(clock, 2_000_000_000)
            play(recorder, clock, 150, first=150)
        recorder.stop()
        status = recorder.save(ANYWAY)
        about = SpoolReader(recorder.spool_root / name).attributes
        assert about.complete is is_complete
        # As the check words a gap: the stream, and the two seconds without a sample.
        expected = "" if is_complete else "head: 2.01 s without a sample"
        assert about.incomplete_cause.startswith(expected)
        assert bool(about.incomplete_cause) is not is_complete
        assert status.session.last_incomplete == about.incomplete_cause
    # Older releases read complete takes: they do not know the fields.
    whole = (recorder.spool_root / "whole" / "recording.json").read_text()
    assert "complete" not in whole
