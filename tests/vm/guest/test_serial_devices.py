"""A glove on a real serial port (CDC ACM) behind a USB gadget."""

import os
import select
import threading
import time
import tty
from itertools import count
from pathlib import Path

import numpy as np

from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.devices.tactile_glove import TactileGloveSettings
from services.acquisition.mocks.gloves import GloveAnswers
from services.acquisition.supervisor import DeviceSupervisor
from tests.vm.guest import kernel_devices, packets
from tests.vm.guest.conftest import (
    MAX_BACK_S,
    MAX_FLAGGED_S,
    PATIENCE_S,
    PAUSE,
    collect,
    replug_row,
    seconds_until_back,
    seconds_until_refused,
)

IDS = (0x1209, 0x0D01)


class GloveOnALine(threading.Thread):
    """The glove's own end: answers at once, and sends packets while it may."""

    def __init__(self, gadget):
        super().__init__(daemon=True)
        self.gadget = gadget
        self.line = None
        self.answers = GloveAnswers(
            "left", serial_number="GLOVE-L", device_time_ns=time.monotonic_ns
        )
        self.packets = iter(())
        self.ended = threading.Event()

    def run(self):
        while not self.ended.wait(1 / 60):
            try:
                self.turn()
            except OSError:
                self.hang_up()
        self.hang_up()

    def turn(self):
        """Answer what was asked, then send the next packet."""
        if self.line is None:
            node = kernel_devices.device_node(self.gadget)
            self.line = os.open(node, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            # As bytes, not as a terminal.
            tty.setraw(self.line)
        while select.select([self.line], [], [], 0)[0]:
            asked = os.read(self.line, 4096)
            if not asked:
                raise ConnectionError("hung up")
            for reply in self.answers.answer(asked):
                self.send(reply)
        for data in self.packets:
            self.send(data)
            break

    def send(self, data):
        """All bytes, as fast as the line takes them."""
        while data:
            select.select([], [self.line], [], PATIENCE_S)
            data = data[os.write(self.line, data) :]

    def hang_up(self):
        """The kernel ends a gadget's line with its plug, for good; the next turn opens it anew."""
        if self.line is not None:
            os.close(self.line)
            self.line = None

    def close(self):
        """End the thread."""
        self.ended.set()
        self.join(PATIENCE_S)


def assert_counts(samples, first):
    for number, sample in enumerate(samples, start=first):
        assert sample.sequence == number
        np.testing.assert_array_equal(sample.values, packets.glove_counts(number))


def test_a_glove_is_found_again_under_another_port(plug, opened, measured):
    gadget = plug(kernel_devices.serial_gadget, ids=IDS, serial_number="GLOVE-L")
    other = plug(kernel_devices.serial_gadget, ids=IDS, serial_number="GLOVE-R")
    gadget.plug(0)
    glove = GloveOnALine(gadget)
    glove.start()
    try:
        driver = opened(TactileGloveSettings(side="left", serial_number="GLOVE-L"))
        assert driver.identity.serial_number == "GLOVE-L"
        (stream,) = (d.name for d in driver.descriptors)
        first_port = driver.info.address
        glove.packets = iter(packets.glove_packets(0, 100))
        assert_counts(collect(driver, stream, 100), 0)
        flagged_s = seconds_until_refused(driver, gadget.unplug)
        driver.close()
        # The other glove takes the name that is free now.
        other.plug(1)
        kernel_devices.until(Path(first_port).exists, within_s=PATIENCE_S, pause=PAUSE)
        back_s = seconds_until_back(driver, lambda: gadget.plug(0))
        assert driver.info.address != first_port
        glove.packets = iter(packets.glove_packets(150, 50))
        assert_counts(collect(driver, stream, 50), 150)
    finally:
        glove.close()
    measured("glove, ACM gadget", "100 packets at 60 Hz", "100 right, 0 lost")
    measured("glove, ACM gadget", *replug_row(flagged_s, back_s))
    assert flagged_s <= MAX_FLAGGED_S
    assert back_s <= MAX_BACK_S
    assert driver.statistics.crc_errors == 0


def test_a_station_reads_on_when_its_glove_is_put_back(plug, measured):
    gadget = plug(kernel_devices.serial_gadget, ids=IDS, serial_number="GLOVE-L")
    gadget.plug()
    glove = GloveOnALine(gadget)
    glove.packets = (data for number in count() for data in packets.glove_packets(number, 1))
    glove.start()
    clock, samples = StationClock(), []
    settings = TactileGloveSettings(side="left", serial_number="GLOVE-L")
    (driver,) = build_drivers([settings], clock)
    station = DeviceSupervisor(
        driver, sink=lambda readings: samples.extend(*readings.values()), clock=clock
    )

    def wait_until(told):
        kernel_devices.until(told, within_s=PATIENCE_S, pause=PAUSE)

    station.start()
    try:
        wait_until(lambda: len(samples) >= 30)
        begun = time.monotonic()
        gadget.unplug()
        wait_until(lambda: not station.connected.is_set())
        flagged_s = time.monotonic() - begun
        num_before = len(samples)
        begun = time.monotonic()
        gadget.plug()
        wait_until(lambda: len(samples) > num_before)
        back_s = time.monotonic() - begun
        wait_until(lambda: len(samples) >= num_before + 30)
    finally:
        station.stop()
        glove.close()
    numbers = [sample.sequence for sample in samples]
    assert numbers == sorted(set(numbers))
    for sample in samples:
        np.testing.assert_array_equal(sample.values, packets.glove_counts(sample.sequence))
    assert station.events()["lost_device"] == 1
    measured("glove, ACM gadget, supervised", *replug_row(flagged_s, back_s))
    assert flagged_s <= MAX_FLAGGED_S
    assert back_s <= MAX_BACK_S
