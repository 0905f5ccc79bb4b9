"""What hidapi is known to do, and what the HID transport makes of it."""

from functools import partial

import hidraw
import pytest

from dextouch.errors import DeviceError
from services.acquisition.transports import HidTransport, UsbAddress, open_hid

REPORT = bytes(range(64))


class ScriptedHid:
    """An opened hidapi device that answers from a script."""

    def __init__(self, reads=(), written=65):
        self.reads = list(reads)
        self.written = written
        self.writes = []
        self.is_closed = False

    def read(self, max_length, timeout_ms=0):
        answer = self.reads.pop(0)
        if isinstance(answer, OSError):
            raise answer
        return answer[:max_length]

    def write(self, buff):
        if isinstance(self.written, OSError):
            raise self.written
        self.writes.append(buff)
        return self.written

    def close(self):
        self.is_closed = True


def opened(device):
    transport = HidTransport(lambda: device, address="28de:2300", serial_number="A1")
    transport.open()
    return transport


def test_an_early_empty_read_means_nothing_yet():
    transport = opened(ScriptedHid([[], [], list(REPORT), []]))
    assert [transport.read() for _ in range(4)] == [b"", b"", REPORT, b""]


def test_a_short_report_is_passed_on_as_it_came():
    assert opened(ScriptedHid([[1, 2, 3]])).read() == b"\1\2\3"


def test_a_read_error_is_loss():
    with pytest.raises(DeviceError, match="hid 28de:2300: unplugged while reading"):
        opened(ScriptedHid([OSError("read error")])).read()


def test_the_report_id_goes_first_and_is_counted():
    device = ScriptedHid(written=65)
    opened(device).write(REPORT)
    assert device.writes == [REPORT]


@pytest.mark.parametrize("written", [-1, 63])
def test_what_was_not_written_whole_is_an_error(written):
    with pytest.raises(DeviceError, match=f"wrote {written} bytes"):
        opened(ScriptedHid(written=written)).write(REPORT)


def test_a_write_error_is_loss():
    with pytest.raises(DeviceError, match="lost while writing"):
        opened(ScriptedHid(written=OSError("write error"))).write(REPORT)


def test_opening_again_closes_first():
    devices = [ScriptedHid(), ScriptedHid()]
    left = list(devices)
    transport = HidTransport(lambda: left.pop(0), address="any")
    transport.open()
    transport.open()
    assert [device.is_closed for device in devices] == [True, False]


def test_devices_are_opened_by_ids_and_serial_number(monkeypatch):
    calls = []

    class Device(ScriptedHid):
        def open(self, *address):
            calls.append(address)

    monkeypatch.setattr(hidraw, "device", Device)
    address = UsbAddress(0x28DE, 0x2300, "A1")
    HidTransport(partial(open_hid, address), address=str(address)).open()
    assert calls == [(0x28DE, 0x2300, "A1")]


def test_the_real_library_says_that_nothing_is_there():
    address = UsbAddress(0xFFFE, 0xFFFE)
    transport = HidTransport(partial(open_hid, address), address=str(address))
    with pytest.raises(DeviceError, match="plugged in, and allowed by udev"):
        transport.open()
