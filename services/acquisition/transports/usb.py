"""Transport to a USB device by pyusb, which gives the same reports as over HID."""

import contextlib
import errno
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dextouch.errors import DeviceError
from services.acquisition.transports.ports import HandleTransport, TransportInfo

if TYPE_CHECKING:
    from usb.backend import IBackend
    from usb.core import Device, Interface

# The number of the interface that sends the reports.
INTERFACE = 0
READ_TIMEOUT_MS = 100
WRITE_TIMEOUT_MS = 500
REPORT_BYTES = 64
# HID 1.11, 7.2.2: SET_REPORT to an interface, an output report; for devices without an OUT endpoint
SET_REPORT_TYPE, SET_REPORT_REQUEST, OUTPUT_REPORT = 0x21, 0x09, 0x0200


@dataclass(frozen=True)
class UsbAddress:
    """Which device: its ids and, where several are alike, its serial number."""

    vendor_id: int
    product_id: int
    serial_number: str | None = None

    def __str__(self) -> str:
        return f"{self.vendor_id:04x}:{self.product_id:04x}"


@dataclass(frozen=True)
class _Opened:
    device: "Device"
    endpoint_in: int
    endpoint_out: int | None
    read_bytes: int


class UsbTransport(HandleTransport[_Opened]):
    """One USB device with an interrupt endpoint; `read` gives one report, b"" means nothing yet.

    Every opening searches for the device by its serial number, so that it is found again after
    replugging, on any port. The kernel's HID driver is detached while the interface is open, and
    reattached on closing.

    Args:
        address: of the device.
        backend: of pyusb; a new context of libusb at every opening if None, since an older one
            learns of what is plugged in only by udev, which does not speak inside containers.
    """

    def __init__(self, address: UsbAddress, *, backend: "IBackend | None" = None) -> None:
        super().__init__(TransportInfo("usb", str(address), address.serial_number))
        self._address = address
        self._backend = backend
        # Outlives the devices found in it: libusb wants them given back before its context ends.
        self._context: IBackend | None = None
        self._detached = False

    def _connect(self) -> _Opened:
        import usb.core

        try:
            self._context = self._backend or _new_context()
            device = self._find()
        except usb.core.NoBackendError as error:
            raise DeviceError(f"{self.info}: libusb-1.0 is not installed ({error})") from error
        try:
            return self._take(device)
        except (OSError, DeviceError):
            self._give_back(device)
            raise

    def _receive(self, handle: _Opened) -> bytes:
        import usb.core

        try:
            data = handle.device.read(handle.endpoint_in, handle.read_bytes, READ_TIMEOUT_MS)
        except OSError as error:
            # Not every backend has the class for it.
            if isinstance(error, usb.core.USBTimeoutError) or error.errno == errno.ETIMEDOUT:
                return b""
            raise
        return data.tobytes()

    def _send(self, handle: _Opened, data: bytes) -> None:
        if handle.endpoint_out is not None:
            written = handle.device.write(handle.endpoint_out, data, WRITE_TIMEOUT_MS)
        else:
            written = handle.device.ctrl_transfer(
                SET_REPORT_TYPE,
                SET_REPORT_REQUEST,
                OUTPUT_REPORT | data[0],
                INTERFACE,
                data,
                WRITE_TIMEOUT_MS,
            )
        if written != len(data):
            raise DeviceError(f"{self.info}: wrote {written} bytes, expected {len(data)}")

    def _release(self, handle: _Opened) -> None:
        """Release the interface; a device that is gone is only forgotten."""
        self._give_back(handle.device)

    def _give_back(self, device: "Device") -> None:
        import usb.util

        detached, self._detached = self._detached, False
        with contextlib.suppress(OSError):  # it may be gone
            usb.util.dispose_resources(device)
            if detached:
                device.attach_kernel_driver(INTERFACE)
                usb.util.dispose_resources(device)

    def _find(self) -> "Device":
        """The one device of this address; handles of others are closed again."""
        import usb.core
        import usb.util

        candidates = list(
            usb.core.find(
                find_all=True,
                backend=self._context,
                idVendor=self._address.vendor_id,
                idProduct=self._address.product_id,
            )
        )
        wanted = self._address.serial_number
        numbers = [_serial_number(device) for device in candidates]
        matching = [
            device
            for device, number in zip(candidates, numbers, strict=True)
            if wanted is None or number == wanted
        ]
        for device in candidates:
            if len(matching) != 1 or device is not matching[0]:
                usb.util.dispose_resources(device)
        if len(matching) == 1:
            return matching[0]
        present = ", ".join(number or "(unreadable)" for number in numbers) or "none"
        if matching:
            raise DeviceError(
                f"{self.info}: {len(matching)} devices match; set serial_number to one of: "
                f"{present}"
            )
        raise DeviceError(
            f"{self.info}: device {wanted or 'of these ids'!r} is not plugged in; present: "
            f"{present}",
            serial_number=wanted,
        )

    def _take(self, device: "Device") -> _Opened:
        import usb.core
        import usb.util

        with contextlib.suppress(NotImplementedError):  # a system without kernel drivers in the way
            if device.is_kernel_driver_active(INTERFACE):
                device.detach_kernel_driver(INTERFACE)
                self._detached = True
        try:
            configuration = device.get_active_configuration()
        except usb.core.USBError:
            device.set_configuration()
            configuration = device.get_active_configuration()
        found = [i for i in configuration if i.bInterfaceNumber == INTERFACE]
        ins = [end for i in found[:1] for end in _interrupt_endpoints(i, usb.util.ENDPOINT_IN)]
        outs = [end for i in found[:1] for end in _interrupt_endpoints(i, usb.util.ENDPOINT_OUT)]
        if not ins:
            raise DeviceError(
                f"{self.info}: interface {INTERFACE} has no interrupt endpoint to read; "
                "another device or firmware?"
            )
        usb.util.claim_interface(device, INTERFACE)
        endpoint_in, packet_bytes = ins[0]
        # Less room than one transfer fills is an overflow error, so never ask for less.
        read_bytes = max(REPORT_BYTES, packet_bytes)
        endpoint_out = outs[0][0] if outs else None
        return _Opened(device, endpoint_in, endpoint_out, read_bytes)


def _new_context() -> "IBackend | None":
    """Another context of libusb, which looks at the bus now; None where there is no libusb."""
    from usb.backend import libusb1

    first = libusb1.get_backend()
    return None if first is None else type(first)(first.lib)


def _interrupt_endpoints(interface: "Interface", direction: int) -> Iterator[tuple[int, int]]:
    """(address, packet size in bytes) of the interrupt endpoints in one direction."""
    import usb.util

    for endpoint in interface:
        is_interrupt = usb.util.endpoint_type(endpoint.bmAttributes) == usb.util.ENDPOINT_TYPE_INTR
        if is_interrupt and usb.util.endpoint_direction(endpoint.bEndpointAddress) == direction:
            yield endpoint.bEndpointAddress, endpoint.wMaxPacketSize


def _serial_number(device: "Device") -> str | None:
    """The serial number, or None where the device has none or does not let us read it."""
    try:
        return device.serial_number
    except (OSError, ValueError):  # no permission; no string descriptors
        return None
