"""A pyusb backend that replays the reports of a simulated USB device."""

import errno
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace

from usb.backend import IBackend
from usb.core import USBError, USBTimeoutError

from services.acquisition.mocks.ports import ReportDevice, ReportPort
from services.acquisition.transports.usb import UsbAddress, UsbTransport

FIFO_REPORTS = 32
GET_DESCRIPTOR, SET_REPORT = 6, 9
STRING_DESCRIPTOR, ENGLISH_US = 3, 0x0409
SERIAL_NUMBER_INDEX = 3
ENDPOINT_IN, ENDPOINT_OUT, INTERRUPT = 0x81, 0x02, 3


@dataclass
class UsbDeviceModel(ReportDevice):
    """One simulated device as the bus sees it.

    Its FIFO keeps 32 reports that the host has not fetched and loses what comes then. Every
    plugging is a new `generation`: handles of an earlier one are dead for ever.
    """

    max_reports = FIFO_REPORTS

    vendor_id: int
    product_id: int
    serial_number: str | None
    has_out_endpoint: bool = True
    has_interrupt_endpoint: bool = True
    packet_bytes: int = 64
    kernel_driver: bool = True
    generation: int = 0
    num_open: int = 0
    is_configured: bool = True

    def set_plugged(self, *, plugged: bool) -> None:
        """Plug it in or out."""
        if plugged:
            self.generation += 1
            self.kernel_driver = True
        self.flush()
        super().set_plugged(plugged=plugged)

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
class _Handle:
    model: UsbDeviceModel
    generation: int

    def check(self) -> None:
        self.model.check(self.generation)


class MockUsbBackend(IBackend):
    """A bus with some simulated devices, as pyusb's own code sees it."""

    def __init__(self, *models: UsbDeviceModel) -> None:
        self.models = list(models)

    def enumerate_devices(self) -> Iterator[object]:
        """The devices that are plugged in."""
        return iter([_Handle(m, m.generation) for m in self.models if m.is_plugged])

    def get_device_descriptor(self, dev: _Handle) -> SimpleNamespace:
        """Ids and the index of the serial number's string."""
        model = dev.model
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x200,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=64,
            idVendor=model.vendor_id,
            idProduct=model.product_id,
            bcdDevice=0x100,
            iManufacturer=0,
            iProduct=0,
            iSerialNumber=SERIAL_NUMBER_INDEX if model.serial_number else 0,
            bNumConfigurations=1,
            address=model.generation,
            bus=1,
            port_number=1,
            port_numbers=(1,),
            speed=2,
        )

    def get_configuration_descriptor(self, dev: object, config: int) -> SimpleNamespace:
        """One configuration with one interface."""
        del dev
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=41,
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0x80,
            bMaxPower=50,
            extra_descriptors=[],
        )

    def get_interface_descriptor(
        self, dev: _Handle, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """One interface of class HID."""
        del config
        if intf or alt:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=len(_endpoints(dev.model)),
            bInterfaceClass=3,
            bInterfaceSubClass=0,
            bInterfaceProtocol=0,
            iInterface=0,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(
        self, dev: _Handle, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """The interrupt endpoints."""
        del intf, alt, config
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=_endpoints(dev.model)[ep],
            bmAttributes=INTERRUPT,
            wMaxPacketSize=dev.model.packet_bytes,
            bInterval=1,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=[],
        )

    def open_device(self, dev: _Handle) -> _Handle:
        """A handle; reports from before are not seen."""
        dev.check()
        dev.model.num_open += 1
        dev.model.flush()
        return _Handle(dev.model, dev.generation)

    def close_device(self, dev_handle: _Handle) -> None:
        """Give a handle back."""
        dev_handle.model.num_open -= 1

    def set_configuration(self, dev_handle: _Handle, config_value: int) -> None:
        """Configure."""
        dev_handle.check()
        dev_handle.model.is_configured = config_value == 1

    def get_configuration(self, dev_handle: _Handle) -> int:
        """1, or 0 while not configured."""
        dev_handle.check()
        return int(dev_handle.model.is_configured)

    def claim_interface(self, dev_handle: _Handle, intf: int) -> None:
        """Refused while the kernel's driver holds it."""
        del intf
        dev_handle.check()
        if dev_handle.model.kernel_driver:
            raise USBError("Resource busy", -6, errno.EBUSY)

    def release_interface(self, dev_handle: _Handle, intf: int) -> None:
        """Release."""
        del intf
        dev_handle.check()

    def is_kernel_driver_active(self, dev_handle: _Handle, intf: int) -> bool:
        """Whether the kernel holds the interface."""
        del intf
        return dev_handle.model.kernel_driver

    def detach_kernel_driver(self, dev_handle: _Handle, intf: int) -> None:
        """Take it from the kernel."""
        del intf
        dev_handle.check()
        dev_handle.model.kernel_driver = False

    def attach_kernel_driver(self, dev_handle: _Handle, intf: int) -> None:
        """Give it back to the kernel."""
        del intf
        dev_handle.check()
        dev_handle.model.kernel_driver = True

    def intr_read(
        self, dev_handle: _Handle, ep: int, intf: int, buff: "array[int]", timeout: int
    ) -> int:
        """One report, a timeout, or EIO."""
        del ep, intf
        report = dev_handle.model.fetch(dev_handle.generation, timeout)
        if len(report) > len(buff):
            raise USBError("Overflow", -8, errno.EOVERFLOW)
        buff[: len(report)] = array("B", report)
        return len(report)

    def intr_write(
        self, dev_handle: _Handle, ep: int, intf: int, data: "array[int]", timeout: int
    ) -> int:
        """A report to the device."""
        del ep, intf, timeout
        return _deliver(dev_handle, data.tobytes())

    def ctrl_transfer(  # noqa: PLR0913, PLR0917 - pyusb's signature
        self,
        dev_handle: _Handle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: "array[int]",
        timeout: int,
    ) -> int:
        """String descriptors, and output reports of devices without an OUT endpoint."""
        del bmRequestType, wIndex, timeout
        dev_handle.check()
        if bRequest == SET_REPORT:
            return _deliver(dev_handle, data.tobytes())
        kind, index = divmod(wValue, 256)
        if bRequest != GET_DESCRIPTOR or kind != STRING_DESCRIPTOR:
            raise USBError("Pipe error", -9, errno.EPIPE)
        text = (dev_handle.model.serial_number or "").encode("utf-16-le")
        body = text if index == SERIAL_NUMBER_INDEX else ENGLISH_US.to_bytes(2, "little")
        answer = bytes([len(body) + 2, STRING_DESCRIPTOR]) + body
        data[: len(answer)] = array("B", answer)
        return len(answer)


class UsbPort(ReportPort):
    """A USB device whose host end is the real USB transport over the real pyusb."""

    def __init__(self, name: str, answer: Callable[[bytes], list[bytes]] | None = None) -> None:
        device = UsbDeviceModel(vendor_id=0x1209, product_id=0xDEC7, serial_number=name)
        address = UsbAddress(device.vendor_id, device.product_id, name)
        transport = UsbTransport(address, backend=MockUsbBackend(device))
        super().__init__(device, transport, answer)


def _endpoints(model: UsbDeviceModel) -> list[int]:
    if not model.has_interrupt_endpoint:
        return []
    return [ENDPOINT_IN, ENDPOINT_OUT] if model.has_out_endpoint else [ENDPOINT_IN]


def _deliver(handle: _Handle, data: bytes) -> int:
    handle.check()
    if handle.model.on_write is not None:
        handle.model.on_write(data)
    return len(data)
