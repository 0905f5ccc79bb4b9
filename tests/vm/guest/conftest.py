"""Runs inside the virtual machine only: real drivers, devices that its kernel made."""

import threading
import time

import pytest

from dextouch.errors import DeviceError
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers

# How long anything may take on an emulated processor.
PATIENCE_S = 20.0
# What a station promises, measured from before the kernel is told; here by the guest's clock.
MAX_FLAGGED_S = 0.3
MAX_BACK_S = 2.0
# Begins the rows of the table; the host looks for it.
ROW = "VM row: "
PAUSE = threading.Event().wait


@pytest.fixture
def measured(capsys):
    """Adds a row to the table that the host prints: device, what was done, what came of it."""

    def note(device, done, result):
        with capsys.disabled():
            print(f"\n{ROW}{device} | {done} | {result}")  # noqa: T201

    return note


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
        (driver,) = build_drivers([settings], StationClock())
        drivers.append(driver)
        reopen(driver)
        return driver

    yield opener
    for driver in drivers:
        driver.close()


def reopen(driver):
    """Open as the station's supervisor does: again until the device is there."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            driver.open()
        except DeviceError:
            if time.monotonic() > deadline:
                raise
            PAUSE(0.02)
        else:
            return


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


def seconds_until_back(driver, plug):
    """How long, from the plug on, until a driver has its device open again."""
    driver.close()
    begun = time.monotonic()
    plug()
    reopen(driver)
    return time.monotonic() - begun


def replug_row(flagged_s, back_s):
    """What was done and what came of it, for the table."""
    return "pulled out, put back", f"loss seen {1e3 * flagged_s:.0f} ms, back {back_s:.2f} s"


def seconds_until_refused(driver, pull):
    """How long a driver takes, from the pull on, to see that its device is gone."""
    begun = time.monotonic()
    pull()
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
