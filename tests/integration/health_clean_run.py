"""Simulated minutes of stations without faults: what their health raised and ended with."""

import json
import sys
from dataclasses import replace

import numpy as np

from services.acquisition.clock import StationClock
from services.acquisition.devices.robot_state import STREAM_SIZES
from services.acquisition.drivers.base import DESCRIPTOR_REPORT
from services.acquisition.health.monitor import TICK_NS, HealthMonitor
from services.acquisition.mock_station import build_mocks
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams
from services.acquisition.mocks.trackers_and_cameras import FingerTrackerSource
from services.acquisition.settings import MockLinks
from services.acquisition.supervisor import DeviceSupervisor

ROUND_S = 16.0
START_NS = 10**12
# What an ordinary station does: skew, a path with a queue, now and then a busy host.
SKEW_PPM, PATH_DELAY_S, JITTER_S = 50.0, 3e-3, 0.8e-3
BUSY_SHARE, BUSY_S = 0.01, 5e-3
# What ordinary sensors do: noise of each taxel, coordinate and pixel.
NOISE = {"tactile": 0.03, "pose": 3e-4, "keypoints": 5e-4, "image": 2.0, "robot_state": 1e-4}
TEXTURE_LEVELS = 20.0
GLOVES, HEAD = ("tactile_left", "tactile_right"), "head"
CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")
FINGERS, WRISTS = ("keypoints_left", "keypoints_right"), ("wrist_left", "wrist_right")


class SetClock(StationClock):
    """A clock that shows what it was set to."""

    def __init__(self):
        self.t_ns = START_NS

    def now_ns(self):
        return self.t_ns

    def waiter(self, *, drives_time=False):
        raise AssertionError("nobody waits on this clock")

    def suspended_ns(self):
        return 0

    def wall_offset_ns(self):
        return 0


class Played:
    """One device's packets with ordinary skew, delay and jitter, decoded as they arrive."""

    def __init__(self, pair, clock, seed):
        self.source, self.driver, self.clock = pair.device.source, pair.driver, clock
        self.supervisor = DeviceSupervisor(pair.driver, sink=lambda _: None, clock=clock)
        self.supervisor.connected.set()
        self.rng = np.random.default_rng(seed)
        self.next = 0
        self.last_ns = START_NS
        self.due_ns, self.stamp_ns = self._plan()
        if isinstance(self.source, FingerTrackerSource):
            for report in self.source.answer(bytes([DESCRIPTOR_REPORT])):
                self.driver.decoder.decode(report, START_NS)

    def _plan(self):
        lap, index = divmod(self.next, len(self.source.t_ns))
        t_ns = round(lap * ROUND_S * 1e9) + int(self.source.t_ns[index])
        delay_s = PATH_DELAY_S + self.rng.exponential(JITTER_S)
        if self.rng.random() < BUSY_SHARE:
            delay_s += self.rng.exponential(BUSY_S)
        self.last_ns = max(self.last_ns, START_NS + t_ns + round(delay_s * 1e9))
        return self.last_ns, 10**15 + t_ns + round(t_ns * SKEW_PPM * 1e-6)

    def play_until(self, t_ns, accept):
        while self.due_ns <= t_ns:
            self.clock.t_ns = self.due_ns
            index = self.next % len(self.source.t_ns)
            for unit in self.source.units(index, self.next, self.stamp_ns):
                readings = self.driver.decoder.decode(unit, self.due_ns)
                if readings:
                    self.supervisor.count(readings)
                    accept(readings)
            self.next += 1
            self.due_ns, self.stamp_ns = self._plan()


def noisy(stream, rng):
    """What a sensor makes of a stream; orientations stay as they are."""
    kind = stream.descriptor.kind
    values = stream.values + rng.normal(0.0, NOISE[kind], stream.values.shape)
    if kind == "pose":
        values[:, 3:] = stream.values[:, 3:]
    if kind == "image":
        values += rng.normal(0.0, TEXTURE_LEVELS, stream.values.shape[1:])
        values = np.clip(values, 10, 240)
    return replace(stream, values=values.astype(stream.values.dtype))


def robot_streams():
    """Six streams of a robot whose wrists move as the pattern's do."""
    wrists = [s for s in pattern_streams(ROUND_S) if s.descriptor.name in WRISTS]
    turn_rad = 2 * np.pi * np.arange(len(wrists[0].t_ns)) / len(wrists[0].t_ns)
    joints = 0.5 * np.sin(turn_rad[:, None] + 0.1 * np.arange(40))
    update = {"kind": "robot_state", "shape": (40,), "unit": "rad", "dtype": "float64"}
    streams = []
    for name in STREAM_SIZES:
        wrist = wrists[0] if "left" in name else wrists[1]
        change = {"name": name} if name.startswith("wrist") else {"name": name, **update}
        values = wrist.values if name.startswith("wrist") else joints
        descriptor = wrist.descriptor.model_copy(update=change)
        streams.append(replace(wrist, descriptor=descriptor, values=values))
    return streams


def run(names, links, minutes):
    clock, rng = SetClock(), np.random.default_rng(7)
    known = [*pattern_streams(ROUND_S), *(s for s in robot_streams() if "joints_measured" in names)]
    streams = {s.descriptor.name: noisy(s, rng) for s in known if s.descriptor.name in names}
    pairs = build_mocks(
        list(streams.values()), faults=FaultScript(), seed=3, clock=clock, links=links
    )
    calibration = pattern_calibration()
    for pair in pairs:
        calibration |= pair.calibration
    devices = [Played(pair, clock, seed) for seed, pair in enumerate(pairs)]
    supervisors = [device.supervisor for device in devices]
    monitor = HealthMonitor(supervisors, calibration=calibration, clock=clock, station="s")

    def accept(readings):
        for name, samples in readings.items():
            monitor.queues[name].add(samples, clock.now_ns())

    for tick in range(1, round(minutes * 60e9 / TICK_NS) + 1):
        end_ns = START_NS + tick * TICK_NS
        for device in devices:
            device.play_until(end_ns, accept)
        clock.t_ns = end_ns
        monitor.tick()
    return monitor


OURS = MockLinks()
STATIONS = {
    "small": (("tactile_left", HEAD), OURS),
    "small_wuji": (("tactile_left", HEAD), MockLinks(gloves="wuji_glove")),
    "small_justfloat": (("tactile_left", HEAD), MockLinks(gloves="justfloat_glove")),
    "human": ((*GLOVES, *FINGERS, *WRISTS, HEAD, *CAMERAS), OURS),
    "robot": ((*GLOVES, HEAD, *CAMERAS, *STREAM_SIZES), OURS),
    "wuji": ((*GLOVES, HEAD), MockLinks(gloves="wuji_glove")),
    "justfloat": ((*GLOVES, HEAD), MockLinks(gloves="justfloat_glove")),
}


def told(station, minutes):
    """Events, levels and counts after so many minutes."""
    monitor = run(*STATIONS[station], minutes)
    report = monitor.report()
    return {
        "raised": [e.model_dump() for e in monitor.events().events if e.level != "OK"],
        "level": report.level,
        "streams": {s.stream: s.level for s in report.streams},
        "samples": {s.stream: s.num_samples for s in report.streams},
        "skew_ppm": {s.stream: s.skew_ppm for s in report.streams},
        "unjudged": monitor.report().figures["unjudged_samples"],
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(told(sys.argv[1], float(sys.argv[2]))))
