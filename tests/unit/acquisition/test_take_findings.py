"""What the health finds while a take runs: entries, problems and figures of that take alone."""

import pytest

from dextouch.schemas import (
    HealthEvent,
    HealthEvents,
    RaisedFinding,
    StationHealth,
    StreamHealth,
    TakeProblem,
)
from services.acquisition.health.monitor import HealthMonitor
from services.acquisition.take import TakeFindings

START_NS = 10**10


class FakeHealth(HealthMonitor):
    """A health whose findings a test raises."""

    def __init__(self):
        self.counts, self.log, self.standing, self.figures = {}, [], [], {}

    def raise_code(self, stream, code, t_host_ns, level="WARN"):
        self.counts[stream, code] = self.counts.get((stream, code), 0) + 1
        event = HealthEvent(t_host_ns=t_host_ns, stream=stream, code=code, level=level)
        self.log.append(event)
        self.standing.append((stream, code))

    def raised(self):
        return dict(self.counts)

    def events(self, since_ns=0):
        found = tuple(event for event in self.log if event.t_host_ns >= since_ns)
        return HealthEvents(now_ns=since_ns, events=found)

    def report(self):
        streams = tuple(self.stream(name) for name in ("head", "camera_head"))
        return StationHealth(station="s", level="OK", streams=streams, devices=())

    def stream(self, name):
        findings = tuple(
            RaisedFinding(code=code, level="WARN", message="m", advice="a", lasted_s=1.0)
            for stream, code in self.standing
            if stream == name
        )
        return StreamHealth(
            stream=name,
            device=name,
            level="OK",
            reasons=(),
            findings=findings,
            figures=self.figures if name == "head" else {},
            rate_hz=None,
            nominal_rate_hz=100,
            age_s=None,
            received=0,
            lost=0,
        )


@pytest.fixture
def health():
    return FakeHealth()


def counted(findings):
    entries = findings.entries(("head", "camera_head"))
    return {(e.stream, e.event): (e.count, e.first_t_host_ns) for e in entries}


def test_what_is_raised_in_a_take_is_counted_with_its_first_time(health):
    health.raise_code("head", "loss", 1)
    health.standing.clear()
    findings = TakeFindings(health, START_NS)
    health.raise_code("camera_head", "image_blurred", START_NS + 5)
    health.raise_code("camera_head", "image_blurred", START_NS + 9, level="ERROR")
    findings.end()
    health.raise_code("head", "jitter", START_NS + 20)
    assert counted(findings) == {("camera_head", "image_blurred"): (2, START_NS + 5)}


def test_what_stands_when_the_take_begins_counts_once(health):
    health.raise_code("head", "taxels_stuck", 1)
    # Never raised: the stream has only not begun yet.
    health.standing.append(("camera_head", "silent"))
    findings = TakeFindings(health, START_NS)
    findings.end()
    assert counted(findings) == {("head", "taxels_stuck"): (1, START_NS)}


def test_streams_of_others_are_left_out(health):
    findings = TakeFindings(health, START_NS)
    health.raise_code("station", "disk", START_NS + 1)
    findings.end()
    assert counted(findings) == {}
    assert findings.problems(("head",), ()) == []


def test_the_worst_of_each_figure_is_kept(health):
    findings = TakeFindings(health, START_NS)
    for skew, drops in ((1e-6, 0.0), (-5e-6, 0.02), (2e-6, 0.01)):
        health.figures = {"clock_skew_ratio": skew, "drop_ratio": drops, "rate_hz": 100.0}
        findings.look()
    health.figures = {}
    findings.end()
    expected = {"head_worst_clock_skew_ratio": -5e-6, "head_worst_drop_ratio": 0.02}
    assert findings.quality() == expected


def test_problems_say_what_to_do_and_nothing_twice(health):
    findings = TakeFindings(health, START_NS)
    health.raise_code("head", "silent", START_NS + 1)
    health.raise_code("camera_head", "silent", START_NS + 1)
    health.raise_code("camera_head", "image_blurred", START_NS + 1)
    findings.end()
    gap = TakeProblem(stream="head", code="gap", level="ERROR", message="a gap")
    found = findings.problems(("head", "camera_head"), (gap,))
    assert [(p.stream, p.code, p.level) for p in found] == [
        ("camera_head", "silent", "WARN"),
        ("camera_head", "image_blurred", "WARN"),
    ]
    assert found[1].message == (
        "camera_head: image_blurred found once. Clean the lens and adjust the focus."
    )
    findings._simulated.add("camera_head")
    plain = findings.problems(("head", "camera_head"), (gap,))
    assert plain[1].message == "camera_head: image_blurred found once"


def test_without_health_there_is_nothing():
    findings = TakeFindings(None, START_NS)
    findings.look()
    findings.end()
    assert counted(findings) == {}
    assert findings.quality() == {}
