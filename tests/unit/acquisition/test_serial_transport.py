"""A serial line that takes nothing in: an error, and soon."""

import os
import tty

import pytest

from dextouch.errors import DeviceError
from services.acquisition.transports.serial import SerialTransport


@pytest.fixture
def line():
    ends = os.openpty()
    for end in ends:
        tty.setraw(end)
    yield ends
    for end in ends:
        os.close(end)


def test_a_device_that_takes_nothing_in_is_refused(line):
    """Seen on a real kernel port: without a bound the write never came back."""
    _, port = line
    transport = SerialTransport(lambda: os.ttyname(port))
    transport.open()
    with pytest.raises(DeviceError, match="lost while writing"):
        transport.write(bytes(1 << 20))
    transport.close()


def test_what_is_taken_in_arrives_whole(line):
    device, port = line
    transport = SerialTransport(lambda: os.ttyname(port))
    transport.open()
    transport.write(b"request")
    assert os.read(device, 100) == b"request"
    transport.close()
