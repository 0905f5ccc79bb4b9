"""Takes of a mock station in simulated time: could the robot's hand follow, and if not, why."""

import pytest

from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pattern import pattern_streams
from services.pipelines.station import load_robot_check

PROMPT = TakePrompt(task="stand_bottle", instruction="stand the bottle up")


def hands(round_s):
    """Keypoints of both hands, which open and close once in so many seconds."""
    streams = [s for s in pattern_streams(round_s) if s.descriptor.kind == "keypoints"]
    return sorted(streams, key=lambda stream: stream.descriptor.name)


def recorded(streams, folder):
    """Check and quality of a second take: in the first the check learns the axes of the hands."""
    with MockStation(
        streams, FaultScript(), 0, VirtualClock(), spool_root=folder, follow=load_robot_check
    ) as station:
        station.run_take(PROMPT)
        take = station.run_take(PROMPT)
        live = {s.stream: s.following for s in station.station.health.report().streams}
    return take.check, SpoolReader(take.spool_path).attributes.quality, live


@pytest.mark.long
def test_hands_that_the_robot_can_follow(tmp_path):
    check, quality, live = recorded(hands(2.0), tmp_path)
    assert check.problems == ()
    shares = {name: value for name, value in quality.items() if "followed" in name}
    assert shares == {f"keypoints_{side}_not_followed_ratio": 0.0 for side in ("left", "right")}
    assert {following.level for following in live.values()} == {"OK"}


@pytest.mark.long
def test_a_hand_that_is_too_fast(tmp_path):
    """Joints of the left hand swing by 0.35 rad at 8 Hz: 17.6 rad/s, where the motors reach 9.6."""
    (left, right), (fast, _) = hands(2.0), hands(0.125)
    left.values[:] = fast.values[[index % len(fast.values) for index in range(len(left.values))]]
    check, quality, live = recorded([left, right], tmp_path)
    (problem,) = check.problems
    assert (problem.stream, problem.code, problem.level) == (
        "keypoints_left",
        "not_followed",
        "WARN",
    )
    assert problem.message.startswith("keypoints_left: the robot's hand could not follow ")
    assert " too fast " in problem.message
    assert check.complete
    assert check.cause.message == problem.message
    share = quality["keypoints_left_not_followed_ratio"]
    assert share > 0.3
    assert f"{share * 100:.0f} % of the time" in problem.message
    assert quality["keypoints_left_not_followed_speed_ratio"] > 0.2
    assert quality["keypoints_right_not_followed_ratio"] == 0.0
    assert live["keypoints_left"].level == "WARN"
    assert set(live["keypoints_left"].fingers.values()) == {"speed"}
