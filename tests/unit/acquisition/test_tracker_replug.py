"""Trackers under a supervisor in real time: loss within 300 ms, back within 2 s of replugging."""

import threading
import time

import numpy as np
import pytest

from services.acquisition.clock import StationClock
from services.acquisition.devices.pose_tracker import (
    BridgePoseTrackerDecoder,
    PoseTrackerDecoder,
)
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.sdk_link import BridgeDriver
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.ports import HidPort
from services.acquisition.mocks.trackers_and_cameras import (
    BridgePort,
    BridgePoseSource,
    PoseTrackerSource,
)
from services.acquisition.supervisor import DeviceSupervisor
from tests.unit.acquisition.usb_bus import UsbPort

# The promises are tried by `make slow`; the default run must not need an idle machine.
within_s = pytest.mark.parametrize(
    ("flag_within_s", "back_within_s"),
    [(60.0, 60.0), pytest.param(0.3, 2.0, marks=pytest.mark.slow)],
    ids=["at all", "in time"],
)
STREAM = next(s for s in pattern_streams(1.0) if s.descriptor.name == "wrist_left")


class Rig:
    """A pose tracker behind a port, and the supervisor that reads it."""

    def __init__(self, link):
        source_class = BridgePoseSource if link == "bridge" else PoseTrackerSource
        self.source = source_class(STREAM, faults=DeviceFaults(), rng=np.random.default_rng(1))
        clock = StationClock()
        if link == "bridge":
            self.port = BridgePort("LHR-left", self.source.hello)
            decoder = BridgePoseTrackerDecoder("wrist_left", serial_number="LHR-left")
            driver = BridgeDriver(
                "pose", transport=self.port.transport, decoder=decoder, clock=clock
            )
        else:
            self.port = (UsbPort if link == "usb" else HidPort)("LHR-left")
            decoder = PoseTrackerDecoder("wrist_left")
            driver = Driver("pose", transport=self.port.transport, decoder=decoder, clock=clock)
        self.sequences = []
        self.arrived = threading.Condition()
        self.supervisor = DeviceSupervisor(driver, sink=self._accept, clock=clock)

    def _accept(self, readings):
        with self.arrived:
            self.sequences += [sample.sequence for sample in readings["wrist_left"]]
            self.arrived.notify_all()

    def send(self, sequences):
        """Send samples and wait until they are through."""
        for sequence in sequences:
            for unit in self.source.units(sequence, sequence, int(STREAM.t_ns[sequence])):
                assert self.port.send(unit)
        with self.arrived:
            last = sequences[-1]
            assert self.arrived.wait_for(lambda: last in self.sequences, 60.0)


@pytest.fixture(params=["hid", "usb", "bridge"])
def rig(request, monkeypatch):
    # A busy machine may be slower with the next sample than a bridge may be silent.
    monkeypatch.setattr("services.acquisition.drivers.sdk_link.SILENCE_NS", 10**10)
    built = Rig(request.param)
    built.port.plug()
    built.supervisor.start()
    assert built.supervisor.connected.wait(60.0)
    yield built
    built.supervisor.stop()
    built.port.unplug()


@within_s
def test_unplugged_and_replugged(rig, flag_within_s, back_within_s):
    rig.send(range(5))
    start_s = time.monotonic()
    rig.port.unplug()
    rig.port.link.wait_closed()
    assert time.monotonic() - start_s <= flag_within_s
    assert not rig.supervisor.connected.is_set()
    assert rig.supervisor.last_error
    start_s = time.monotonic()
    rig.port.plug()
    assert rig.supervisor.connected.wait(60.0)
    assert time.monotonic() - start_s <= back_within_s
    rig.send(range(8, 12))
    assert rig.sequences == [*range(5), *range(8, 12)]
    assert rig.supervisor.driver.statistics.lost == 3
