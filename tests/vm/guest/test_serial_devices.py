"""A glove on a real serial port (CDC ACM) behind a USB gadget."""

import os
import select
import threading
import time
import tty
from pathlib import Path

import numpy as np

from services.acquisition.mocks.glove_answers import GloveAnswers
from services.acquisition.settings import TactileGloveSettings
from tests.vm.guest import kernel_devices, packets
from tests.vm.guest.conftest import PATIENCE_S, PAUSE, collect, reopen, seconds_until_refused

IDS = (0x1209, 0x0D01)


class GloveOnALine(threading.Thread):
    """The glove's own end: answers at once, and sends packets while it may."""

    def __init__(self, gadget):
        super().__init__(daemon=True)
        self.line = os.open(
            kernel_devices.device_node(gadget), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK
        )
        # As bytes, not as a terminal.
        tty.setraw(self.line)
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
                # Pulled out: what is written or read now goes nowhere.
                continue

    def turn(self):
        """Answer what was asked, then send the next packet."""
        while select.select([self.line], [], [], 0)[0]:
            asked = os.read(self.line, 4096)
            if not asked:
                break
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

    def close(self):
        """End the thread."""
        self.ended.set()
        self.join(PATIENCE_S)
        os.close(self.line)


def assert_counts(samples, first):
    for number, sample in enumerate(samples, start=first):
        assert sample.sequence == number
        np.testing.assert_array_equal(sample.values, packets.glove_counts(number))


def test_a_glove_is_found_again_under_another_port(plug, opened, capsys):
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
        gadget.unplug()
        flagged_s = seconds_until_refused(driver)
        driver.close()
        # The other glove takes the name that is free now.
        other.plug(1)
        kernel_devices.until(Path(first_port).exists, within_s=PATIENCE_S, pause=PAUSE)
        gadget.plug(0)
        back_s = reopen(driver)
        assert driver.info.address != first_port
        glove.packets = iter(packets.glove_packets(150, 50))
        assert_counts(collect(driver, stream, 50), 150)
    finally:
        glove.close()
    with capsys.disabled():
        print(f"\nserial: unplug seen after {1e3 * flagged_s:.0f} ms, back after {back_s:.2f} s")  # noqa: T201
    assert flagged_s <= 0.3
    assert back_s <= 2.0
    assert driver.statistics.crc_errors == 0
