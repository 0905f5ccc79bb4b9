"""A serial line that takes nothing in: an error, and soon."""

import os
import threading
import tty

import pytest
import serial
from structlog.testing import capture_logs

from dextouch.errors import DeviceError
from services.acquisition import transports as serial_transport
from services.acquisition.transports import SerialTransport


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


@pytest.mark.parametrize("error", [TypeError("an integer is required"), ValueError("fd is -1")])
def test_a_port_that_closes_during_a_write_is_a_lost_device(line, monkeypatch, error):
    """What pyserial raises when its descriptor vanishes between two portions of a write."""
    transport = SerialTransport(lambda: os.ttyname(line[1]))
    transport.open()

    def vanish(*_):
        raise error

    monkeypatch.setattr(serial.Serial, "write", vanish)
    with pytest.raises(DeviceError, match="lost while writing"):
        transport.write(b"request")
    transport.close()


def test_a_port_that_does_not_close_holds_nobody_up(line, monkeypatch):
    """Seen with a USB device that takes nothing in: the kernel keeps its port for 30 s."""
    may_close, close = threading.Event(), serial.Serial.close

    def close_later(port):
        may_close.wait()
        close(port)

    monkeypatch.setattr(serial_transport, "CLOSE_TIMEOUT_S", 0.05)
    transport = SerialTransport(lambda: os.ttyname(line[1]))
    transport.open()
    monkeypatch.setattr(serial.Serial, "close", close_later)
    # It returns although the port cannot close before the end of this test.
    with capture_logs() as logs:
        transport.close()
    assert [log["event"] for log in logs] == ["wait_for_port_to_close"]
    with pytest.raises(DeviceError, match="still being closed"):
        transport.open()
    may_close.set()
    transport._closing.join()
    transport.open()
    transport.close()


def test_a_port_that_fails_to_close_is_said(line, monkeypatch):
    transport = SerialTransport(lambda: os.ttyname(line[1]))
    transport.open()
    close = serial.Serial.close

    def fail(port):
        close(port)
        raise OSError(5, "gone")

    monkeypatch.setattr(serial.Serial, "close", fail)
    with capture_logs() as logs:
        transport.close()
    assert [log["event"] for log in logs] == ["fail_to_close_port"]
