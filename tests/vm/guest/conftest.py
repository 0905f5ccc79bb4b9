"""Runs inside the virtual machine only: real drivers, devices that its kernel made."""

import threading
import time

import pytest

from dextouch.errors import DeviceError
from services.acquisition.clock import RealClock
from services.acquisition.devices import build_drivers
from tests.vm.guest import kernel_devices

# How long anything may take on an emulated processor.
PATIENCE_S = 20.0
PAUSE = threading.Event().wait


@pytest.fixture
def plug():
    """Gadgets that are pulled out and forgotten at the end."""
    made = []

    def maker(make, **how):
        gadget = make(**how)
        made.append(gadget)
        return gadget

    yield maker
    for gadget in made:
        gadget.remove()


@pytest.fixture
def opened():
    """The driver of some settings, opened when the kernel has its device ready."""
    drivers = []

    def opener(settings):
        (driver,) = build_drivers([settings], RealClock())
        drivers.append(driver)
        reopen(driver)
        return driver

    yield opener
    for driver in drivers:
        driver.close()


def reopen(driver):
    """Open as the station's supervisor does: again until the device is there; seconds it took."""
    begun = time.monotonic()

    def ready():
        try:
            driver.open()
        except DeviceError:
            return False
        return True

    kernel_devices.until(ready, within_s=PATIENCE_S, pause=PAUSE)
    return time.monotonic() - begun


def collect(driver, stream, count):
    """The next samples of a stream.

    Raises:
        TimeoutError: they did not come.
    """
    samples, deadline = [], time.monotonic() + PATIENCE_S
    while len(samples) < count:
        samples += driver.read().get(stream, [])
        if time.monotonic() > deadline:
            raise TimeoutError(f"{stream}: got {len(samples)} of {count} samples")
    return samples


def seconds_until_refused(driver):
    """How long a driver takes to see that its device is gone."""
    begun = time.monotonic()
    with pytest.raises(DeviceError, match=r"unplug|gone|lost"):
        _read_for_long(driver, begun + PATIENCE_S)
    return time.monotonic() - begun


def _read_for_long(driver, deadline):
    while time.monotonic() < deadline:
        driver.read()


class Sender(threading.Thread):
    """Writes what it is given to a device's own side, paced."""

    def __init__(self, write, units, *, period_s=0.01):
        super().__init__(daemon=True)
        self.write, self.units, self.period_s = write, units, period_s

    def run(self):
        for unit in self.units:
            self.write(unit)
            PAUSE(self.period_s)


@pytest.fixture
def send():
    """Send in a thread of its own, waited for at the end."""
    senders = []

    def sender(write, units, **how):
        senders.append(Sender(write, units, **how))
        senders[-1].start()
        return senders[-1]

    yield sender
    for each in senders:
        each.join(PATIENCE_S)
        assert not each.is_alive()
