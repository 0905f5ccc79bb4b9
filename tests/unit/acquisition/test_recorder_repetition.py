"""Actions that name their take may be sent again; an action for another take is refused."""

import shutil

import pytest

from dextouch.errors import ConflictError
from dextouch.schemas import SaveTake, TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.devices.pose_tracker import PoseTrackerDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.mocks.ports import HidPort
from services.acquisition.recorder import Recorder

PROMPT = TakePrompt(task="stand_bottle", instruction="stand the bottle up")


@pytest.fixture
def recorder(tmp_path):
    clock = VirtualClock(10**9)
    port, decoder = HidPort("b"), PoseTrackerDecoder("head")
    driver = Driver("pose_tracker_head", transport=port.transport, decoder=decoder, clock=clock)
    made = Recorder(
        station="test", spool_root=tmp_path, drivers=[driver], clock=clock, calibration={}
    )
    yield made
    made.close()


def how(recording_id, success=None):
    return SaveTake(recording_id=recording_id, success=success, accept_incomplete=True)


def test_repeated_actions_change_nothing_and_answer_the_same(recorder):
    recorder.arm(PROMPT)
    assert recorder.record("a") == recorder.record("a")
    assert recorder.stop("a") == recorder.stop("a")
    # A start that was long answered and comes once more does not start anything either.
    assert recorder.record("a").state == "checking"
    assert recorder.save(how("a")) == recorder.save(how("a"))
    assert recorder.stop("a").state == "saved"
    assert [p.name for p in recorder.spool_root.iterdir() if p.is_dir()] == ["a"]


def test_another_take_is_refused(recorder):
    recorder.arm(PROMPT)
    recorder.record("a")
    for action in (recorder.record, recorder.stop, recorder.discard, recorder.rerecord):
        with pytest.raises(ConflictError, match="take 'b', the present one is 'a'"):
            action("b")
    recorder.stop("a")
    with pytest.raises(ConflictError, match="take 'b'"):
        recorder.save(how("b"))
    recorder.save(how("a", success=True))
    with pytest.raises(ConflictError, match="was saved with success=True"):
        recorder.save(how("a", success=False))
    recorder.arm(PROMPT)
    with pytest.raises(ConflictError, match="spool 'a' exists"):
        recorder.record("a")
    with pytest.raises(ConflictError, match="the present one is None"):
        recorder.stop("a")


def test_discard_may_be_repeated(recorder):
    recorder.arm(PROMPT)
    recorder.record("a")
    assert recorder.discard("a") == recorder.discard("a")
    assert list(recorder.spool_root.iterdir()) == []


@pytest.mark.long
def test_rerecord_arms_the_same_prompt(recorder):
    recorder.arm(PROMPT)
    recorder.record("a")
    recorder.stop("a")
    status = recorder.rerecord("a")
    assert (status.state, status.prompt, status.recording_id) == ("armed", PROMPT, None)
    assert recorder.rerecord("a") == status
    assert list(recorder.spool_root.iterdir()) == []
    assert recorder.record("b").prompt == PROMPT
    recorder.stop("b")
    recorder.save(how("b"))
    with pytest.raises(ConflictError, match="cannot rerecord while saved"):
        recorder.rerecord("b")
    shutil.rmtree(recorder.spool_root / "b")
