"""A USB bus of simulated devices behind the real pyusb, and trackers of a mock station on it.

Descriptors hold what the transport and pyusb ask for; their other fields are 0.
"""

import errno
import threading
from array import array
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest
from usb.backend import IBackend
from usb.core import USBError, USBTimeoutError

from services.acquisition.mocks.ports import MockPort, WatchedTransport
from services.acquisition.transports import UsbAddress, UsbTransport

SET_REPORT = 9
FIFO_REPORTS = 32
GET_DESCRIPTOR = 6
STRING_DESCRIPTOR, ENGLISH_US = 3, 0x0409
SERIAL_NUMBER_INDEX = 3
ENDPOINT_IN, ENDPOINT_OUT, INTERRUPT = 0x81, 0x02, 3


class Descriptor(SimpleNamespace):
    """A descriptor of the USB standard whose fields are 0 but for those named."""

    def __getattr__(self, name: str) -> int:
        if name.startswith("_"):
            raise AttributeError(name)
        return 0


@dataclass
class UsbDeviceModel:
    """One simulated device as the bus sees it; `on_write` takes the reports of the host.

    Its FIFO keeps 32 reports that the host has not fetched and loses what comes then. Every
    plugging is a new `generation`: handles of an earlier one are dead for ever.
    """

    vendor_id: int
    product_id: int
    serial_number: str | None
    packet_bytes: int = 64
    endpoints: tuple[int, ...] = (ENDPOINT_IN, ENDPOINT_OUT)
    generation: int = 0
    on_write: Callable[[bytes], None] | None = None
    is_plugged: bool = False
    _reports: deque[bytes] = field(default_factory=deque)
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def set_plugged(self, *, plugged: bool) -> None:
        """Plug it in or out."""
        with self._changed:
            self.generation += int(plugged)
            self._reports.clear()
            self.is_plugged = plugged
            self._changed.notify_all()

    def push(self, report: bytes) -> bool:
        """A report (or half of one) for the host; False when as many wait as it can keep."""
        with self._changed:
            if len(self._reports) >= FIFO_REPORTS:
                return False
            self._reports.append(report)
            self._changed.notify_all()
            return True

    def flush(self) -> None:
        """Forget unread reports."""
        with self._changed:
            self._reports.clear()

    def fetch(self, generation: int, timeout_ms: int) -> bytes:
        """What an interrupt transfer of the host gets."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._reports or not self._is(generation), timeout_ms / 1000
            )
            if not self._is(generation):
                raise USBError("Input/Output Error", -1, errno.EIO)
            if not self._reports:
                raise USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
            return self._reports.popleft()

    def check(self, generation: int) -> None:
        """Raise what libusb says when the device has gone."""
        if not self._is(generation):
            raise USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)

    def _is(self, generation: int) -> bool:
        return self.is_plugged and generation == self.generation


@dataclass
class UsbHandle:
    """A device from one plugging to its unplugging."""

    model: UsbDeviceModel
    generation: int

    def check(self) -> None:
        """Raise what libusb says when the device has gone."""
        self.model.check(self.generation)

    def deliver(self, data: "array[int]") -> int:
        """A report to the device; how many bytes it took."""
        self.check()
        if self.model.on_write is not None:
            self.model.on_write(data.tobytes())
        return len(data)


class MockUsbBackend(IBackend):
    """A bus with some simulated devices, as pyusb's own code sees it."""

    def __init__(self, *models: UsbDeviceModel) -> None:
        self.models = list(models)

    def enumerate_devices(self) -> Iterator[object]:
        """The devices that are plugged in."""
        return iter([UsbHandle(m, m.generation) for m in self.models if m.is_plugged])

    def get_device_descriptor(self, dev: UsbHandle) -> Descriptor:
        """Ids and the index of the serial number's string."""
        model = dev.model
        return Descriptor(
            idVendor=model.vendor_id,
            idProduct=model.product_id,
            iSerialNumber=SERIAL_NUMBER_INDEX if model.serial_number else 0,
            bNumConfigurations=1,
            address=model.generation,
            bus=1,
        )

    def get_configuration_descriptor(self, dev: object, config: int) -> Descriptor:
        """One configuration with one interface."""
        del dev
        if config:
            raise IndexError(config)
        return Descriptor(bNumInterfaces=1, bConfigurationValue=1, extra_descriptors=[])

    def get_interface_descriptor(
        self, dev: UsbHandle, intf: int, alt: int, config: int
    ) -> Descriptor:
        """One interface."""
        del config
        if intf or alt:
            raise IndexError(intf)
        return Descriptor(bNumEndpoints=len(dev.model.endpoints), extra_descriptors=[])

    def get_endpoint_descriptor(
        self, dev: UsbHandle, ep: int, intf: int, alt: int, config: int
    ) -> Descriptor:
        """The interrupt endpoints."""
        del intf, alt, config
        return Descriptor(
            bEndpointAddress=dev.model.endpoints[ep],
            bmAttributes=INTERRUPT,
            wMaxPacketSize=dev.model.packet_bytes,
            extra_descriptors=[],
        )

    def open_device(self, dev: UsbHandle) -> UsbHandle:
        """A handle; reports from before are not seen."""
        dev.check()
        dev.model.flush()
        return dev

    def close_device(self, dev_handle: UsbHandle) -> None:
        """Nothing is held."""

    def get_configuration(self, dev_handle: UsbHandle) -> int:
        """It is configured."""
        dev_handle.check()
        return 1

    def claim_interface(self, dev_handle: UsbHandle, intf: int) -> None:
        """Claim."""
        del intf
        dev_handle.check()

    def release_interface(self, dev_handle: UsbHandle, intf: int) -> None:
        """Release."""
        del intf
        dev_handle.check()

    def intr_read(
        self, dev_handle: UsbHandle, ep: int, intf: int, buff: "array[int]", timeout: int
    ) -> int:
        """One report, a timeout, or EIO."""
        del ep, intf
        report = dev_handle.model.fetch(dev_handle.generation, timeout)
        if len(report) > len(buff):
            raise USBError("Overflow", -8, errno.EOVERFLOW)
        buff[: len(report)] = array("B", report)
        return len(report)

    def intr_write(
        self, dev_handle: UsbHandle, ep: int, intf: int, data: "array[int]", timeout: int
    ) -> int:
        """A report to the device."""
        del ep, intf, timeout
        return dev_handle.deliver(data)

    def ctrl_transfer(
        self,
        dev_handle: UsbHandle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: "array[int]",
        timeout: int,
    ) -> int:
        """String descriptors."""
        del bmRequestType, wIndex, timeout
        dev_handle.check()
        kind, index = divmod(wValue, 256)
        if bRequest != GET_DESCRIPTOR or kind != STRING_DESCRIPTOR:
            raise USBError("Pipe error", -9, errno.EPIPE)
        text = (dev_handle.model.serial_number or "").encode("utf-16-le")
        body = text if index == SERIAL_NUMBER_INDEX else ENGLISH_US.to_bytes(2, "little")
        answer = bytes([len(body) + 2, STRING_DESCRIPTOR]) + body
        data[: len(answer)] = array("B", answer)
        return len(answer)


class UsbPort(MockPort):
    """A USB device whose host end is the real USB transport over the real pyusb."""

    def __init__(self, name, answer=None):
        super().__init__()
        self.device = UsbDeviceModel(vendor_id=0x1209, product_id=0xDEC7, serial_number=name)
        if answer is not None:
            self.device.on_write = lambda report: [self.send(unit) for unit in answer(report)]
        address = UsbAddress(self.device.vendor_id, self.device.product_id, name)
        transport = UsbTransport(address, backend=MockUsbBackend(self.device))
        self.transport = WatchedTransport(transport, self.link)

    def plug(self):
        self.device.set_plugged(plugged=True)

    def unplug(self):
        self.device.set_plugged(plugged=False)

    def send(self, unit):
        self.link.add_sent(len(unit))
        taken = self.device.push(unit)
        if not taken:
            self.link.add_sent(-len(unit))
        return taken


@contextmanager
def usb_trackers():
    """Mock trackers that are made meanwhile are on USB instead of HID."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("services.acquisition.mocks.trackers_and_cameras.HidPort", UsbPort)
        yield


@dataclass
class OddUsbDevice(UsbDeviceModel):
    """A device that the kernel's driver holds after every plugging, and that counts its handles."""

    kernel_driver: bool = True
    num_open: int = 0
    is_configured: bool = True

    def set_plugged(self, *, plugged):
        self.kernel_driver |= plugged
        super().set_plugged(plugged=plugged)


class OddUsbBus(MockUsbBackend):
    """The bus of a system with kernel drivers, as Linux has them."""

    def open_device(self, dev):
        handle = super().open_device(dev)
        handle.model.num_open += 1
        return handle

    def close_device(self, dev_handle):
        dev_handle.model.num_open -= 1

    def set_configuration(self, dev_handle, config_value):
        dev_handle.check()
        dev_handle.model.is_configured = config_value == 1

    def get_configuration(self, dev_handle):
        dev_handle.check()
        return int(dev_handle.model.is_configured)

    def claim_interface(self, dev_handle, intf):
        super().claim_interface(dev_handle, intf)
        if dev_handle.model.kernel_driver:
            raise USBError("Resource busy", -6, errno.EBUSY)

    def is_kernel_driver_active(self, dev_handle, intf):
        return dev_handle.model.kernel_driver

    def detach_kernel_driver(self, dev_handle, intf):
        dev_handle.check()
        dev_handle.model.kernel_driver = False

    def attach_kernel_driver(self, dev_handle, intf):
        dev_handle.check()
        dev_handle.model.kernel_driver = True

    def ctrl_transfer(self, dev_handle, kind, request, value, index, data, timeout):
        if request == SET_REPORT:
            return dev_handle.deliver(data)
        return super().ctrl_transfer(dev_handle, kind, request, value, index, data, timeout)
