"""The USB transport through pyusb's own code, on a simulated bus."""

import errno

import pytest
import usb.core

from dextouch.errors import DeviceError
from services.acquisition.transports import UsbAddress, UsbTransport
from tests.unit.acquisition.usb_bus import (
    ENDPOINT_IN,
    ENDPOINT_OUT,
    FIFO_REPORTS,
    OddUsbBus,
    OddUsbDevice,
)

REPORT = bytes(range(64))
IDS = (0x28DE, 0x2300)


def model(serial_number="A1", **settings):
    device = OddUsbDevice(*IDS, serial_number, **settings)
    device.set_plugged(plugged=True)
    return device


def transport(*devices, serial_number="A1"):
    backend = OddUsbBus(*devices)
    return UsbTransport(UsbAddress(*IDS, serial_number), backend=backend)


@pytest.fixture
def device():
    return model()


@pytest.fixture
def opened(device):
    transport_ = transport(device)
    transport_.open()
    yield transport_
    transport_.close()


def test_reports_come_whole_and_in_order(device, opened):
    reports = [bytes([number]) * 64 for number in range(5)]
    assert all(device.push(report) for report in reports)
    assert [opened.read() for _ in reports] == reports


def test_timeout_means_nothing_yet(opened):
    assert opened.read() == b""


def test_half_a_report_is_passed_on_as_it_came(device, opened):
    device.push(REPORT[:20])
    assert opened.read() == REPORT[:20]


def test_large_transfers_do_not_overflow():
    device = model(packet_bytes=512)
    link = transport(device)
    link.open()
    device.push(bytes(512))
    assert link.read() == bytes(512)


def test_unplugging_is_an_error_at_once(device, opened):
    device.push(REPORT)
    device.set_plugged(plugged=False)
    with pytest.raises(DeviceError, match="unplugged while reading"):
        opened.read()
    opened.close()
    with pytest.raises(DeviceError, match="not plugged in; present: none"):
        opened.open()


def test_unplugging_says_errno_5(device, opened):
    device.set_plugged(plugged=False)
    with pytest.raises(DeviceError) as caught:
        opened.read()
    assert isinstance(caught.value.__cause__, usb.core.USBError)
    assert caught.value.__cause__.errno == errno.EIO


def test_a_dead_handle_stays_dead_after_replugging(device, opened):
    device.set_plugged(plugged=False)
    device.set_plugged(plugged=True)
    with pytest.raises(DeviceError, match="unplugged"):
        opened.read()
    opened.open()
    device.push(REPORT)
    assert opened.read() == REPORT


class ContextWithoutEvents(OddUsbBus):
    """A context of libusb that nobody tells of changes: it knows what it saw when it was made."""

    def __init__(self, lib):
        super().__init__(*(device for device in lib if device.is_plugged))
        self.lib = lib


def test_what_is_plugged_in_later_is_found_where_udev_is_silent(monkeypatch, device):
    device.set_plugged(plugged=False)
    first = ContextWithoutEvents([device])
    monkeypatch.setattr("usb.backend.libusb1.get_backend", lambda: first)
    link = UsbTransport(UsbAddress(*IDS, "A1"))
    with pytest.raises(DeviceError, match="not plugged in; present: none"):
        link.open()
    for _ in range(2):
        device.set_plugged(plugged=True)
        link.open()
        device.push(REPORT)
        assert link.read() == REPORT
        device.set_plugged(plugged=False)
        with pytest.raises(DeviceError, match="unplugged"):
            link.read()
    link.close()


def test_found_by_serial_number_whatever_else_is_plugged_in():
    others = [model("B2"), model("C3")]
    wanted = model("A1")
    link = transport(*others, wanted)
    link.open()
    wanted.push(REPORT)
    assert link.read() == REPORT
    # Handles that were only opened to read a serial number are closed again.
    assert [device.num_open for device in (*others, wanted)] == [0, 0, 1]
    link.close()
    assert wanted.num_open == 0


def test_another_serial_number_is_not_taken():
    with pytest.raises(DeviceError, match="'A1' is not plugged in; present: B2"):
        transport(model("B2")).open()


def test_two_alike_need_a_serial_number():
    with pytest.raises(DeviceError, match="set serial_number to one of: A1, B2"):
        transport(model("A1"), model("B2"), serial_number=None).open()
    link = transport(model(None), serial_number=None)
    link.open()
    assert str(link.info) == "usb 28de:2300"


def test_the_kernel_gets_its_interface_back(device):
    link = transport(device)
    link.open()
    assert not device.kernel_driver
    link.close()
    assert device.kernel_driver
    link.close()


@pytest.mark.parametrize("endpoints", [(ENDPOINT_IN, ENDPOINT_OUT), (ENDPOINT_IN,)])
def test_commands_reach_the_device(endpoints):
    seen = []
    device = model(endpoints=endpoints, on_write=seen.append)
    link = transport(device)
    link.open()
    link.write(REPORT)
    assert seen == [REPORT]
    device.set_plugged(plugged=False)
    with pytest.raises(DeviceError, match="lost while writing"):
        link.write(REPORT)


def test_unconfigured_device_is_configured():
    device = model(is_configured=False)
    link = transport(device)
    link.open()
    assert device.is_configured


@pytest.mark.parametrize(("settings", "interface"), [({"endpoints": ()}, 0), ({}, 1)])
def test_device_without_the_endpoint_is_refused_and_released(settings, interface, monkeypatch):
    monkeypatch.setattr("services.acquisition.transports.INTERFACE", interface)
    device = model(**settings)
    with pytest.raises(DeviceError, match="no interrupt endpoint"):
        transport(device).open()
    assert device.num_open == 0
    assert device.kernel_driver


def test_reports_beyond_the_device_fifo_are_refused(device, opened):
    taken = [device.push(REPORT) for _ in range(FIFO_REPORTS + 3)]
    assert taken == [True] * FIFO_REPORTS + [False] * 3
    assert opened.read() == REPORT


def test_closed_transport_refuses(device):
    with pytest.raises(DeviceError, match="not open"):
        transport(device).read()
    with pytest.raises(DeviceError, match="not open"):
        transport(device).write(REPORT)
