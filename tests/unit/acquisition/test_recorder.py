import errno
import gc
import os
import shutil
import weakref

import numpy as np
import pytest

from dextouch.episodes.spool import SpoolReader
from dextouch.errors import ConflictError, InvalidInputError, StorageError, UnavailableError
from dextouch.schemas import SaveTake, TakePrompt
from dextouch.streams import Sample
from services.acquisition.clock import VirtualClock
from services.acquisition.devices.pose_tracker import PoseTrackerDecoder
from services.acquisition.devices.tactile_glove import TactileGloveDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.mocks.ports import HidPort, PtyPort
from services.acquisition.recorder import CALIBRATION, Recorder
from services.acquisition.retention import spooled_takes
from services.acquisition.uploader import recover_spool
from services.alignment.station_calibration import glove, runs

PROMPT = TakePrompt(task="stand_bottle", instruction="stand the bottle up", consent=True)
ANYWAY = SaveTake(accept_incomplete=True)


@pytest.fixture
def clock():
    return VirtualClock(10**9)


@pytest.fixture
def recorder(tmp_path, clock):
    glove, tracker = TactileGloveDecoder("left"), PoseTrackerDecoder("head")
    drivers = [
        Driver("glove_left", transport=PtyPort("a").transport, decoder=glove, clock=clock),
        Driver("pose_tracker_head", transport=HidPort("b").transport, decoder=tracker, clock=clock),
    ]
    return Recorder(
        station="test",
        spool_root=tmp_path,
        drivers=drivers,
        clock=clock,
        calibration={"K_head": ((1.0,),)},
    )


def advance(clock, duration_ns):
    waiter = clock.waiter(drives_time=True)
    waiter.wait_until(clock.now_ns() + duration_ns)
    waiter.close()


def deliver(recorder, readings):
    """As a station does."""
    if recorder.take is not None:
        recorder.take.accept(readings)


def play(recorder, clock, seconds, streams=("tactile_left", "head")):
    rest, pose = np.full(360, 120, np.uint16), np.array([0.0, 0, 0, 1, 0, 0, 0])
    for index in range(round(seconds * 100)):
        counts = rest + np.uint16(index % 3)
        now_ns = clock.now_ns()
        if "head" in streams:
            deliver(recorder, {"head": [Sample(now_ns, pose, 5, index)]})
        if "tactile_left" in streams and index % 5 in (0, 1, 3):
            deliver(recorder, {"tactile_left": [Sample(now_ns, counts, 5, index)]})
        advance(clock, 10_000_000)


def take(recorder, clock, seconds=2.0, **options):
    recorder.arm(PROMPT)
    recorder.record("take")
    play(recorder, clock, seconds, **options)
    return recorder.stop()


@pytest.mark.parametrize(
    ("who", "missing"),
    [({"consent": True}, "no operator"), ({"operator": "p7"}, "no consent"), ({}, "no operator")],
)
def test_a_take_of_nobody_is_not_armed_where_consent_is_needed(recorder, who, missing):
    recorder.needs_consent = True
    asked = {"task": "stand_bottle", "instruction": "stand the bottle up"}
    with pytest.raises(InvalidInputError, match=f"got {missing}, expected the pseudonym"):
        recorder.arm(TakePrompt(**asked, **who))
    assert recorder.status().state == "idle"
    # Of devices and boards nobody has to agree.
    assert recorder.arm(TakePrompt(task="calibrate-glove", instruction="rest")).state == "armed"
    assert recorder.arm(TakePrompt(**asked, operator="p7", consent=True)).state == "armed"


def test_the_takes_of_guided_runs_need_no_operator():
    assert set(CALIBRATION) == {glove.TASK, runs.TIME_TASK}


def test_a_take_from_prompt_to_spool(recorder, clock, tmp_path):
    assert recorder.status().state == "idle"
    assert recorder.arm(PROMPT).state == "armed"
    play(recorder, clock, 0.1)
    assert recorder.record("take").state == "recording"
    play(recorder, clock, 2.0)
    assert recorder.status().duration_s == pytest.approx(2.0)
    status = recorder.stop()
    assert status.state == "checking"
    assert status.check.complete
    assert status.num_samples == {"tactile_left": 120, "head": 200}
    assert recorder.save(SaveTake(success=True)).state == "saved"
    spool = SpoolReader(tmp_path / "take")
    assert spool.closed
    assert spool.attributes.success
    assert spool.attributes.task == "stand_bottle"
    assert spool.attributes.consent
    assert spool.attributes.started_t_host_ns == 10**9 + 100_000_000
    assert spool.attributes.calibration == {"K_head": ((1.0,),)}
    assert spool.num_samples("tactile_left") == 120
    assert recorder.arm(PROMPT).recording_id is None


@pytest.mark.parametrize("action", ["record", "stop", "discard"])
def test_order_of_actions_is_kept(recorder, action):
    with pytest.raises(ConflictError, match="possible now: arm"):
        getattr(recorder, action)()


def test_recording_cannot_be_armed_or_saved(recorder):
    recorder.arm(PROMPT)
    recorder.record()
    with pytest.raises(ConflictError, match="while recording"):
        recorder.arm(PROMPT)
    with pytest.raises(ConflictError, match="possible now: stop, discard"):
        recorder.save(SaveTake())


def test_discarded_takes_leave_nothing(recorder, clock, tmp_path):
    take(recorder, clock)
    assert recorder.discard().state == "discarded"
    assert list(tmp_path.iterdir()) == []


def test_a_discarded_take_does_not_come_back_however_its_removal_ends(
    recorder, clock, tmp_path, monkeypatch
):
    def fail(path, **_):
        if path.exists():
            raise OSError(errno.EIO, "a bad sector")

    take(recorder, clock)
    monkeypatch.setattr(shutil, "rmtree", fail)
    with pytest.raises(StorageError):
        recorder.discard()
    monkeypatch.undo()
    # As after a kill in between.
    assert spooled_takes(tmp_path) == []
    assert recorder.discard().state == "discarded"
    assert recover_spool(tmp_path) == []
    assert list((tmp_path / ".removed").iterdir()) == []


def test_a_take_that_was_removed_by_hand_can_be_discarded(recorder, clock, tmp_path):
    shutil.rmtree(tmp_path / take(recorder, clock).recording_id)
    assert recorder.rerecord().state == "armed"


def test_missing_stream_is_named_and_not_saved_unasked(recorder, clock):
    status = take(recorder, clock, streams=("head",))
    assert [(p.stream, p.code) for p in status.check.problems] == [
        ("tactile_left", "missing_stream")
    ]
    assert "tactile_left" in status.problems[0]
    with pytest.raises(ConflictError, match="incomplete: tactile_left"):
        recorder.save(SaveTake())
    assert recorder.status().state == "checking"
    assert recorder.save(ANYWAY).state == "saved"


def test_gap_and_rate_are_found(recorder, clock):
    recorder.arm(PROMPT)
    recorder.record()
    play(recorder, clock, 1.0)
    play(recorder, clock, 0.5, streams=("head",))
    play(recorder, clock, 1.0)
    codes = {(p.stream, p.code, p.level) for p in recorder.stop().check.problems}
    assert codes == {("tactile_left", "gap", "ERROR"), ("tactile_left", "rate", "ERROR")}


def test_readers_make_their_bytes_before_they_hold_the_lock(recorder, clock, monkeypatch):
    recorder.arm(PROMPT)
    recorder.record("take")
    running, held = recorder.take, []
    encode, write = running.spool.encode, running.spool.append_record

    def noting(call):
        def call_and_note(*args):
            held.append(running._lock._is_owned())
            return call(*args)

        return call_and_note

    monkeypatch.setattr(running.spool, "encode", noting(encode))
    monkeypatch.setattr(running.spool, "append_record", noting(write))
    play(recorder, clock, 0.01)
    assert held == [False, True] * 2


def test_a_packet_missing_since_before_the_take_is_no_gain(recorder, clock):
    counter, values = recorder._drivers["glove_left"].decoder.statistics, np.zeros(360, np.uint16)
    counter.lost = 3
    recorder.arm(PROMPT)
    recorder.record("take")
    recorder.take.accept({"tactile_left": [Sample(clock.now_ns(), values, 5, 1)]})
    counter.lost, counter.late = 2, 1
    (glove, _) = recorder.stop().check.streams
    assert (glove.stream, glove.lost) == ("tactile_left", 0)


def test_full_disk_keeps_what_is_there(recorder, clock, tmp_path, monkeypatch):
    recorder.arm(PROMPT)
    recorder.record("take")
    play(recorder, clock, 0.5)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "writev", full)
    play(recorder, clock, 0.1)
    monkeypatch.undo()
    status = recorder.status()
    assert status.state == "checking"
    assert "space" in status.problems[0].lower()
    play(recorder, clock, 0.1)
    assert recorder.save(ANYWAY).state == "saved"
    assert SpoolReader(tmp_path / "take").num_samples("head") == 50


def test_unsaved_takes_stay_in_the_spool(recorder, clock, tmp_path):
    take(recorder, clock)
    recorder.close()
    spool = SpoolReader(tmp_path / "take")
    assert not spool.closed
    assert spool.num_samples("head") == 200


def test_prompt_needs_an_instruction():
    with pytest.raises(ValueError, match="instruction"):
        TakePrompt(task="a", instruction="")


def test_an_old_take_is_free_at_once_and_waits_for_no_collector(recorder, clock):
    recorder.arm(PROMPT)
    recorder.record()
    play(recorder, clock, 1.0)
    recorder.stop()
    recorder.save(ANYWAY)
    take = weakref.ref(recorder.take)
    gc.disable()
    try:
        recorder.arm(PROMPT)
        assert take() is None
    finally:
        gc.enable()


def counts(recorder):
    session = recorder.status().session
    return {(s.task, s.operator): s.num_saved for s in session.saved}, session.last_saved


@pytest.mark.long
def test_saved_takes_are_counted_and_the_count_outlives_the_process(recorder, clock, tmp_path):
    for operator, recording_id in (("p7", "a"), ("p7", "b"), ("p8", "c")):
        recorder.arm(PROMPT.model_copy(update={"operator": operator}))
        for keep in (False, True):
            recorder.record(recording_id)
            recorder.stop()
            if not keep:
                recorder.rerecord()
        recorder.save(SaveTake(recording_id=recording_id, accept_incomplete=True))
        recorder.save(SaveTake(recording_id=recording_id, accept_incomplete=True))
    expected = {("stand_bottle", "p7"): 2, ("stand_bottle", "p8"): 1}, "c"
    assert counts(recorder) == expected
    again = Recorder(station="test", spool_root=tmp_path, drivers=(), clock=clock, calibration={})
    assert counts(again) == expected
    again.begin_session()
    assert counts(again) == ({}, "c")
    again = Recorder(station="test", spool_root=tmp_path, drivers=(), clock=clock, calibration={})
    assert counts(again) == ({}, "c")


def test_a_damaged_count_starts_anew(recorder, clock, tmp_path):
    (tmp_path / "session.json").write_text("{")
    again = Recorder(station="test", spool_root=tmp_path, drivers=(), clock=clock, calibration={})
    assert counts(again) == ({}, None)


def test_a_spool_that_is_gone_takes_no_take_and_is_not_created_anew(recorder, clock):
    recorder.arm(PROMPT)
    recorder.record()
    recorder.discard()
    shutil.rmtree(recorder.spool_root)
    recorder.arm(PROMPT)
    with pytest.raises(UnavailableError, match=f"spool {recorder.spool_root}: is gone"):
        recorder.record()
    assert recorder.status().state == "armed"
    assert not recorder.spool_root.exists()
    recorder.spool_root.mkdir()
    with pytest.raises(UnavailableError, match="is another folder than at the start"):
        recorder.record()
