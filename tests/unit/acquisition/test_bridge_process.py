"""Bridges as sockets and processes of their own: life signs, several stations, kill -9."""

import json
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from dextouch.errors import DeviceError, StaleDataError
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.mock_bridge import BridgeServer, pattern_source
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.replay import MockSlot
from services.acquisition.mocks.trackers_and_cameras import bridged_pair
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


@pytest.mark.long
def test_a_bridge_without_samples_still_lives(kind, monkeypatch):
    # Longer than the real limit of 200 ms, so that a busy machine is not taken for a dead bridge.
    monkeypatch.setattr("services.acquisition.drivers.sdk_link.SILENCE_NS", 10**9)
    source, clock = pattern_source(kind, DEVICES[kind][0], seed=0), StationClock()
    place = MockSlot("bridge", pattern_streams()[0], DeviceFaults(), 0, clock)
    pair = bridged_pair(place, source, driver_of(kind, 1).decoder)
    pair.device.port.plug()
    pair.driver.open()
    end_s = time.monotonic() + 1.2
    while time.monotonic() < end_s:
        assert pair.driver.read() == {}
    assert pair.driver.statistics.packets >= 2
    pair.driver.close()
    pair.device.port.unplug()


@pytest.fixture
def port(kind):
    server = BridgeServer(pattern_source(kind, DEVICES[kind][0], seed=0))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server.server_address[1]
    server.shutdown()
    thread.join()
    server.server_close()


def test_two_stations_hear_the_same(kind, port):
    drivers = [driver_of(kind, port) for _ in range(2)]
    for driver in drivers:
        driver.open()
    heard = [{s.sequence: s for s in read_samples(driver, 100)} for driver in drivers]
    for driver in drivers:
        driver.close()
    both = heard[0].keys() & heard[1].keys()
    assert both
    for sequence in both:
        first, second = (samples[sequence] for samples in heard)
        assert first.t_device_ns == second.t_device_ns
        assert first.values.tobytes() == second.values.tobytes()


@pytest.mark.long
@pytest.mark.system
def test_a_bridge_that_ends_is_lost(kind):
    with bridge_process(kind) as (process, port):
        driver = driver_of(kind, port)
        driver.open()
        process.terminate()
        with pytest.raises(DeviceError, match="closed by the device"):
            read_until_lost(driver)
        driver.close()


@pytest.mark.long
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
