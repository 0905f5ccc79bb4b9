"""Watch of the robot's hand: what it counts, says and shows, and that no reader waits for it."""

import threading
from collections import Counter

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.schemas import TakePrompt
from dextouch.streams import Sample, StreamDescriptor
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.watches import FollowCounts, FollowWatch

MS = 1_000_000
PROMPT = TakePrompt(task="stand_bottle", instruction="stand the bottle up")
STREAM = StreamDescriptor(
    name="keypoints_left",
    kind="keypoints",
    shape=(25, 3),
    dtype="float32",
    unit="m",
    nominal_rate_hz=30,
    side="left",
)
HEAD = STREAM.model_copy(update={"name": "head", "kind": "pose", "shape": (7,), "side": None})


class Script:
    """A check whose answers a test gives one by one; the last one stays."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.elapsed_s = []

    def __call__(self, keypoints_m, elapsed_s):
        self.elapsed_s.append(elapsed_s)
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer


def watch(check):
    return FollowWatch([HEAD, STREAM], {}, lambda side, _: check, clock=VirtualClock())


def see(watched, *times_ms):
    """Samples at these times, each looked at."""
    for t_ms in times_ms:
        sample = Sample(t_ms * MS, np.zeros((25, 3), dtype=np.float32))
        watched.accept({"keypoints_left": [sample]})
        watched.look()


def live(watched, now_ms):
    return watched.live("keypoints_left", now_ms * MS)


def test_only_tracked_hands_are_checked():
    assert set(watch(Script({})).counts()) == {"keypoints_left"}
    assert watch(Script({})).live("head", 0) is None
    assert FollowWatch([STREAM], {}, None, clock=VirtualClock()).counts() == {}


def test_each_sample_is_checked_once_with_the_time_since_the_one_before():
    check = Script({})
    watched = watch(check)
    see(watched, 100, 150)
    watched.look()
    assert check.elapsed_s == pytest.approx([1 / 30, 0.05])
    assert watched.counts()["keypoints_left"] == FollowCounts(num_checks=2)


def test_causes_are_shown_for_as_long_as_they_last_and_a_moment():
    watched = watch(Script({}, {"index": "limit", "thumb": "speed"}, {"index": "limit"}, {}))
    see(watched, 100)
    assert (live(watched, 100).level, live(watched, 100).fingers) == ("OK", {})
    see(watched, 140, 300)
    shown = live(watched, 310)
    assert shown.fingers == {"index": "limit", "thumb": "speed"}
    assert shown.message == "robot cannot follow: index at the joint limit · thumb too fast"
    assert (shown.level, shown.lasted_s) == ("WARN", pytest.approx(0.16))
    see(watched, 500)
    # Of the thumb nothing was found for longer than 0.3 s.
    assert live(watched, 500).fingers == {"index": "limit"}
    see(watched, 620)
    assert live(watched, 620).level == "OK"
    assert live(watched, 1121) is None


def test_what_cannot_be_checked_says_why_and_is_tried_again():
    watched = watch(Script(None, InvalidInputError("turned by 90 degrees"), {}))
    see(watched, 100)
    assert (live(watched, 100).level, live(watched, 100).message) == (
        "STALE",
        "robot's hand: not checked yet",
    )
    see(watched, 140)
    assert live(watched, 140).message == "robot's hand not checked: turned by 90 degrees"
    see(watched, 180)
    assert live(watched, 180).level == "OK"
    assert watched.counts()["keypoints_left"].num_checks == 1


def test_a_check_that_cannot_be_made_is_not_made_again():
    asked = []

    def refuse(side, calibration):
        asked.append(side)
        raise InvalidInputError("no valid profile")

    watched = FollowWatch([STREAM], {}, refuse, clock=VirtualClock())
    see(watched, 100, 140)
    assert asked == ["left"]
    assert live(watched, 140).message == "robot's hand not checked: no valid profile"


def test_a_check_that_fails_ends_nothing():
    watched = watch(Script(ZeroDivisionError(), {}))
    see(watched, 100)
    assert "see the station's log" in live(watched, 100).message
    see(watched, 140)
    assert live(watched, 140).level == "OK"


def test_the_share_of_a_take_and_its_causes():
    before = FollowCounts().plus({"little": "unseen"})
    counts = before
    for index in range(100):
        missed = {"index": "limit"} if index < 10 else {"thumb": "speed", "index": "speed"}
        counts = counts.plus(missed if index < 12 else {})
    take = counts.since(before)
    assert (take.num_checks, take.num_missed) == (100, 12)
    expected = {("index", "limit"): 10, ("thumb", "speed"): 2, ("index", "speed"): 2}
    assert take.causes == Counter(expected)
    assert take.figures() == {
        "not_followed_ratio": 0.12,
        "not_followed_limit_ratio": 0.1,
        "not_followed_speed_ratio": 0.02,
    }
    assert take.words().startswith(
        "the robot's hand could not follow 12 % of the time: index at the joint limit 10 %, "
    )


def test_a_second_of_checks_is_needed_for_a_share():
    counts = FollowCounts()
    for _ in range(29):
        counts = counts.plus({"index": "limit"})
    assert counts.figures() == {}
    assert counts.plus({}).figures()["not_followed_ratio"] == pytest.approx(29 / 30)


def test_a_check_that_hangs_costs_no_sample(tmp_path):
    """It loads during the whole take: its thread waits on a real clock, all others on simulated."""
    streams = [s for s in pattern_streams(1.0) if s.descriptor.kind == "keypoints"]
    hangs, goes_on = threading.Event(), threading.Event()

    def load(side, calibration):
        hangs.set()
        goes_on.wait(30)
        return Script({})

    played = MockStation(streams, FaultScript(), 0, VirtualClock(), spool_root=tmp_path)
    descriptors = [d for pair in played.pairs for d in pair.driver.descriptors]
    follow = FollowWatch(descriptors, {}, load, clock=StationClock())
    played.station.follow = follow
    with played:
        assert hangs.wait(30)
        take = played.run_take(PROMPT)
        assert not goes_on.is_set()
        now_ns = played.station.clock.now_ns()
        assert follow.live("keypoints_left", now_ns).message == "robot's hand: not checked yet"
    goes_on.set()
    counted = {stream.stream: (stream.num_samples, stream.lost) for stream in take.check.streams}
    assert counted == {f"keypoints_{side}": (120, 0) for side in ("left", "right")}
