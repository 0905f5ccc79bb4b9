import numpy as np
import pytest

from dextouch.streams.samples import Sample
from services.acquisition.clock import VirtualClock
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.pose_tracker import PoseTrackerDecoder
from services.acquisition.drivers.tactile_glove import TactileGloveDecoder
from services.acquisition.health import HealthMonitor, Hysteresis
from services.acquisition.live import LiveView
from services.acquisition.mocks.ports import HidPort, PtyPort
from services.acquisition.supervisor import DeviceSupervisor

CALIBRATION = {
    "tactile_left_tare_counts": ((100.0,) * 360,),
    "tactile_left_gain_counts_per_kpa": ((40.0,) * 360,),
}


class Bench:
    """Two supervised devices whose counters the test moves by hand."""

    def __init__(self):
        self.clock = VirtualClock(10**9)
        drivers = [
            Driver(
                "glove_left",
                transport=PtyPort("a").transport,
                decoder=TactileGloveDecoder("left"),
                clock=self.clock,
            ),
            Driver(
                "pose_tracker_head",
                transport=HidPort("b").transport,
                decoder=PoseTrackerDecoder("head"),
                clock=self.clock,
            ),
        ]
        self.live = LiveView(drivers, CALIBRATION)
        self.supervisors = [
            DeviceSupervisor(driver, sink=self.live.accept, clock=self.clock) for driver in drivers
        ]
        self.monitor = HealthMonitor(
            self.supervisors, live=self.live, clock=self.clock, station="bench"
        )
        self.counts = np.full(360, 100, np.uint16)

    def second(self, *, rate=1.0, lost=0, crc=0, evaluate=True):
        values = (self.counts, np.array([0.0, 0, 0, 1, 0, 0, 0]))
        for supervisor, value, rate_hz in zip(self.supervisors, values, (60, 100), strict=True):
            (name,) = supervisor.counters.streams
            start_ns = self.clock.now_ns()
            count = round(rate_hz * rate)
            stamps = start_ns + np.arange(1, count + 1) * 1_000_000_000 // count
            readings = {name: [Sample(int(t), value) for t in stamps]}
            supervisor.counters.add(readings)
            self.live.accept(supervisor.driver.name, readings)
            supervisor.driver.statistics.packets += count
        self.supervisors[0].driver.statistics.lost += lost
        self.supervisors[0].driver.statistics.crc_errors += crc
        self.wait(1.0)
        if evaluate:
            self.monitor.evaluate()

    def wait(self, seconds):
        waiter = self.clock.waiter(drives_time=True)
        waiter.wait_until(self.clock.now_ns() + round(seconds * 1e9))
        waiter.close()

    def levels(self):
        return {s.stream: s.level for s in self.monitor.report().streams}

    def reasons(self):
        return {s.stream: s.reasons for s in self.monitor.report().streams}


@pytest.fixture
def bench():
    return Bench()


def test_silent_devices_are_stale(bench):
    assert bench.levels() == {"tactile_left": "STALE", "head": "STALE"}
    assert bench.monitor.report().level == "STALE"


def test_a_clean_run_alerts_nobody(bench):
    for _ in range(40):
        bench.second()
        assert bench.levels() == {"tactile_left": "OK", "head": "OK"}
    stream = bench.monitor.report().streams[0]
    assert stream.rate_hz == pytest.approx(60, rel=0.01)
    assert stream.age_s == pytest.approx(0)
    assert stream.received == 2400


def test_silence_shows_within_300_ms(bench):
    bench.second()
    bench.wait(0.1)
    assert bench.levels()["tactile_left"] == "WARN"
    bench.wait(0.15)
    assert set(bench.levels().values()) == {"STALE"}


@pytest.mark.parametrize(
    ("change", "level", "word"),
    [
        ({"rate": 0.96}, "WARN", "Hz"),
        ({"rate": 0.8}, "ERROR", "Hz"),
        ({"lost": 1}, "ERROR", "lost"),
        ({"crc": 1}, "ERROR", "damaged"),
    ],
)
def test_faults_raise_after_two_evaluations_and_clear_later(bench, change, level, word):
    for _ in range(11):
        bench.second()
    for _ in range(12):
        bench.second(**change)
    assert bench.levels()["tactile_left"] == level
    assert word in bench.reasons()["tactile_left"][0]
    if "rate" not in change:
        assert bench.levels()["head"] == "OK"
    for _ in range(16):
        bench.second()
    assert bench.levels()["tactile_left"] == "OK"
    assert bench.reasons()["tactile_left"] == ()


def test_dead_taxels_are_counted(bench):
    bench.counts[[3, 77]] = 0
    for _ in range(7):
        bench.second()
    assert bench.levels()["tactile_left"] == "WARN"
    assert bench.reasons()["tactile_left"] == ("2 taxels dead or saturated",)
    bench.counts[:30] = 65535
    for _ in range(8):
        bench.second()
    assert bench.levels()["tactile_left"] == "ERROR"


def test_reconnects_are_mentioned(bench):
    for _ in range(3):
        bench.second()
    bench.supervisors[1].counters.reconnects += 1
    for _ in range(3):
        bench.second()
    assert bench.levels()["head"] == "WARN"
    assert bench.reasons()["head"] == ("1 reconnects",)


def test_hysteresis():
    hysteresis = Hysteresis()
    seen = [hysteresis.update(level) for level in ["WARN", "OK", "WARN", "WARN"] + 5 * ["OK"]]
    assert seen == ["OK", "OK", "OK", "WARN", "WARN", "WARN", "WARN", "WARN", "OK"]


def test_live_pressures_are_in_kpa_and_never_old(bench):
    bench.counts[:] = 180
    bench.second()
    pressures = bench.live.pressures_kpa(bench.clock.now_ns())
    assert set(pressures) == {"tactile_left"}
    np.testing.assert_allclose(pressures["tactile_left"], 2.0)
    bench.wait(0.6)
    assert bench.live.pressures_kpa(bench.clock.now_ns()) == {}
