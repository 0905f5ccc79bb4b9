"""Bridges as sockets and processes of their own: life signs, several stations, kill -9."""

import json
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

from dextouch.errors import DeviceError, StaleDataError
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.mock_bridge import pattern_source
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.replay import MockDevice, MockPlace
from services.acquisition.mocks.sdk_link import BridgeServer, signs_of_life
from services.acquisition.settings import AcquisitionSettings

# The promises are tried by `make slow`; the default run must not need an idle machine.
within_s = pytest.mark.parametrize(
    ("flag_within_s", "back_within_s"),
    [(60.0, 60.0), pytest.param(0.3, 2.0, marks=pytest.mark.slow)],
    ids=["at all", "in time"],
)
DEVICES = {
    "finger_tracker": ("left", {"side": "left", "serial_number": "MF-left"}, "keypoints_left"),
    "pose_tracker": ("head", {"stream": "head", "serial_number": "LHR-head"}, "head"),
}


def driver_of(kind, port):
    device = {"kind": kind, "link": "bridge", "port": port, **DEVICES[kind][1]}
    (driver,) = build_drivers(AcquisitionSettings(devices=(device,)).devices, StationClock())
    return driver


def read_samples(driver, count):
    """So many samples; a machine that is too busy for the signs of life connects again."""
    stream = driver.descriptors[0].name
    samples = []
    while len(samples) < count:
        try:
            samples += driver.read().get(stream, [])
        except StaleDataError:
            driver.close()
            driver.open()
    return samples


def read_until_lost(driver):
    while True:
        driver.read()


@pytest.fixture(params=DEVICES)
def kind(request):
    return request.param


class Bridge:
    """A bridge process's server and device, played by hand."""

    def __init__(self, kind):
        self.source = pattern_source(kind, DEVICES[kind][0], seed=0)
        self.server = BridgeServer(self.source.hello)
        place = MockPlace("b", pattern_streams()[0], DeviceFaults(), 0, StationClock())
        self.device = MockDevice(place, self.source, self.server)

    def send_sample(self, index, t_device_ns):
        self.device.send_aside(lambda n: b"".join(self.source.units(index, n, t_device_ns)))


@pytest.fixture
def bridge(kind):
    made = Bridge(kind)
    life = signs_of_life(made.device, made.source.magic, StationClock())
    made.server.plug()
    life.start()
    yield made
    life.stop()
    made.server.unplug()


@pytest.fixture
def server(bridge):
    return bridge.server


def test_a_bridge_without_samples_still_lives(kind, server, monkeypatch):
    # Longer than the real limit of 200 ms, so that a busy machine is not taken for a dead bridge.
    monkeypatch.setattr("services.acquisition.drivers.sdk_link.SILENCE_NS", 10**9)
    driver = driver_of(kind, server.port)
    driver.open()
    end_s = time.monotonic() + 1.2
    while time.monotonic() < end_s:
        assert driver.read() == {}
    assert driver.statistics.packets >= 2
    driver.close()


def test_two_stations_hear_the_same(kind, bridge):
    drivers = [driver_of(kind, bridge.server.port) for _ in range(2)]
    for driver in drivers:
        driver.open()
    for index in range(5):
        bridge.send_sample(index, 10**12 + index * 10**7)
    values = [[s.values.tobytes() for s in read_samples(driver, 5)] for driver in drivers]
    assert len(values[0]) == 5
    assert values[0] == values[1]
    for driver in drivers:
        driver.close()


def test_a_bridge_that_ends_is_lost(kind, server):
    driver = driver_of(kind, server.port)
    driver.open()
    server.disconnect()
    with pytest.raises(DeviceError, match="closed by the device"):
        read_until_lost(driver)
    driver.close()


@contextmanager
def bridge_process(kind, *options):
    command = [sys.executable, "-m", "services.acquisition.mock_bridge", kind]
    with subprocess.Popen(
        [*command, DEVICES[kind][0], *options], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process, json.loads(process.stdout.readline())["port"]
        finally:
            process.kill()


@pytest.mark.system
@within_s
def test_a_killed_bridge_is_flagged_and_its_successor_found(kind, flag_within_s, back_within_s):
    stream = DEVICES[kind][2]
    (replay,) = (s for s in pattern_streams() if s.descriptor.name == stream)
    with bridge_process(kind) as (process, port):
        driver = driver_of(kind, port)
        driver.open()
        samples = read_samples(driver, 20)
        process.send_signal(signal.SIGKILL)
        killed_s = time.monotonic()
        with pytest.raises(DeviceError):
            read_until_lost(driver)
        assert time.monotonic() - killed_s <= flag_within_s
        driver.close()
    with bridge_process(kind, "--port", str(port)):
        listening_s = time.monotonic()
        driver.open()
        samples += read_samples(driver, 20)
        assert time.monotonic() - listening_s <= back_within_s
        driver.close()
    # Every sample is one of the pattern's, to the precision of float32 numbers on the wire.
    for sample in samples:
        errors = np.abs(replay.values - sample.values).reshape(len(replay.values), -1).max(axis=1)
        assert errors.min() < 1e-6
