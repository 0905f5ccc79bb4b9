"""Simulated minutes of devices without faults, real bytes and decoders: nothing is raised."""

import numpy as np
import pytest

from services.acquisition.health import TICK_NS, HealthMonitor
from services.acquisition.live import LiveView
from services.acquisition.mocks.devices import MockFactory
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams
from services.acquisition.supervisor import DeviceSupervisor

ROUND_S = 8.0
START_NS = 10**12
SKEW_PPM, PATH_DELAY_S, JITTER_S = 50.0, 3e-3, 0.5e-3


class SetClock:
    """A clock that shows what it was set to."""

    def __init__(self):
        self.t_ns = START_NS

    def now_ns(self):
        return self.t_ns

    def waiter(self, *, drives_time=False):
        raise AssertionError("nobody waits on this clock")


class Played:
    """One device's packets with ordinary skew, delay and jitter, decoded as they arrive."""

    def __init__(self, pair, clock, live, seed):
        self.pair, self.clock, self.live = pair, clock, live
        self.supervisor = DeviceSupervisor(pair.driver, sink=live.accept, clock=clock)
        self.supervisor.counters.is_connected = True
        self.rng = np.random.default_rng(seed)
        self.next = 0
        self.last_ns = START_NS
        self.due_ns, self.stamp_ns = self._plan()

    def _plan(self):
        lap, index = divmod(self.next, len(self.pair.device.source.t_ns))
        t_ns = round(lap * ROUND_S * 1e9) + int(self.pair.device.source.t_ns[index])
        delay_s = PATH_DELAY_S + self.rng.exponential(JITTER_S)
        self.last_ns = max(self.last_ns, START_NS + t_ns + round(delay_s * 1e9))
        return self.last_ns, 10**15 + t_ns + round(t_ns * SKEW_PPM * 1e-6)

    def play_until(self, t_ns):
        source, driver = self.pair.device.source, self.pair.driver
        while self.due_ns <= t_ns:
            self.clock.t_ns = self.due_ns
            index = self.next % len(source.t_ns)
            for unit in source.units(index, self.next, self.stamp_ns):
                readings = driver.decoder.decode(unit, self.due_ns)
                if readings:
                    self.supervisor.counters.add(readings)
                    self.live.accept(driver.name, readings)
            self.next += 1
            self.due_ns, self.stamp_ns = self._plan()


def run(names, minutes):
    clock = SetClock()
    streams = [s for s in pattern_streams(ROUND_S) if s.descriptor.name in names]
    factory = MockFactory(streams, faults=FaultScript(), seed=3, clock=clock)
    pairs = factory.build()
    calibration = {**pattern_calibration(), **factory.calibration()}
    live = LiveView([pair.driver for pair in pairs], calibration)
    devices = [Played(pair, clock, live, seed) for seed, pair in enumerate(pairs)]
    monitor = HealthMonitor([d.supervisor for d in devices], live=live, clock=clock, station="s")
    for tick in range(1, round(minutes * 60e9 / TICK_NS) + 1):
        end_ns = START_NS + tick * TICK_NS
        for device in devices:
            device.play_until(end_ns)
        clock.t_ns = end_ns
        monitor.tick()
    return monitor


STATION = ("tactile_left", "tactile_right", "wrist_left", "wrist_right", "head", "camera_head")


@pytest.mark.parametrize(
    ("names", "minutes"),
    [
        (("tactile_left", "head"), 0.5),
        pytest.param(("tactile_left", "head"), 10, marks=pytest.mark.slow),
        pytest.param(STATION, 10, marks=pytest.mark.slow),
    ],
    ids=["half_a_minute", "glove_and_tracker", "station"],
)
def test_clean_minutes_raise_nothing(names, minutes):
    monitor = run(names, minutes)
    report = monitor.report()
    assert {stream.stream: stream.level for stream in report.streams} == dict.fromkeys(names, "OK")
    assert [event for event in monitor.events().events if event.level != "OK"] == []
    assert report.level == "OK"
    glove = next(s for s in report.streams if s.stream == "tactile_left")
    assert glove.skew_ppm == pytest.approx(-SKEW_PPM, abs=3)
    assert glove.num_samples == pytest.approx(3600 * minutes, abs=1)
