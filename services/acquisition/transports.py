"""Ways to a device: serial lines, HID and USB devices and stream sockets, as drivers read them."""

import contextlib
import errno
import os
import select
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import structlog

from dextouch.errors import DeviceError

if TYPE_CHECKING:
    import serial
    from usb.backend import IBackend
    from usb.core import Device, Interface

logger = structlog.get_logger(__name__)

Handle = TypeVar("Handle")
# What we use of an opened hidapi device, which has no types: `read`, `write` and `close`.
HidDevice = Any

READ_TIMEOUT_S = 0.1
REPORT_BYTES = 64
CONNECT_TIMEOUT_S = 2.0
# A device that takes nothing in must not hold up the station for ever.
WRITE_TIMEOUT_S = 0.5
# The kernel keeps a closing port for up to 30 s while the device takes nothing in; only root may
# shorten that.
CLOSE_TIMEOUT_S = 1.0
# More than a kernel buffer of a serial line holds: one read takes all that has come.
SERIAL_READ_BYTES = 65_536
READ_BYTES = 1 << 18
# The number of the interface that sends the reports.
INTERFACE = 0
READ_TIMEOUT_MS = 100
WRITE_TIMEOUT_MS = 500
# HID 1.11, 7.2.2: SET_REPORT to an interface, an output report; for devices without an OUT endpoint
SET_REPORT_TYPE, SET_REPORT_REQUEST, OUTPUT_REPORT = 0x21, 0x09, 0x0200


@dataclass(frozen=True)
class TransportInfo:
    """Where a transport leads, for messages and the dashboard."""

    kind: str
    address: str
    serial_number: str | None = None

    def __str__(self) -> str:
        return f"{self.kind} {self.address}"


class HandleTransport(ABC, Generic[Handle]):
    """Way to one device, over what a library opens: a port, a device, a socket, a camera.

    Every failure of the link is a DeviceError; an OSError of the library is one. `arrived_ns` is
    when what the last `read` gave arrived, by the station's clock; None where that is when `read`
    returned.
    """

    # What to look at where it cannot be opened.
    advice: ClassVar = "is it plugged in, and allowed by udev?"
    arrived_ns: int | None = None

    def __init__(self, info: TransportInfo) -> None:
        self.info = info
        self._handle: Handle | None = None

    def open(self) -> None:
        """Find and open the device; an open one is closed first.

        Raises:
            DeviceError: absent, taken by another process, not permitted, or not to be opened.
        """
        self.close()
        try:
            self._handle = self._connect()
        # The latter of a host that has no possible name.
        except (OSError, UnicodeError) as error:
            raise DeviceError(f"{self.info}: cannot be opened ({error}); {self.advice}") from error

    def read(self) -> bytes:
        """All that has arrived, or one report, waiting up to 0.1 s; b"" means: nothing yet.

        Raises:
            DeviceError: not open, or the device is gone.
        """
        try:
            return self._receive(self._opened())
        except OSError as error:
            raise DeviceError(f"{self.info}: unplugged while reading ({error})") from error

    def write(self, data: bytes) -> None:
        """Send all bytes; of devices of reports one report, whose first byte is its id.

        Raises:
            DeviceError: not open, or the device is gone or takes no such data.
        """
        try:
            self._send(self._opened(), data)
        except OSError as error:
            raise DeviceError(f"{self.info}: lost while writing ({error})") from error

    def close(self) -> None:
        """Give the device back; closing twice is fine."""
        handle, self._handle = self._handle, None
        if handle is not None:
            self._release(handle)

    def _opened(self) -> Handle:
        if self._handle is None:
            raise DeviceError(f"{self.info}: not open")
        return self._handle

    @abstractmethod
    def _connect(self) -> Handle:
        """Open the device anew."""

    @abstractmethod
    def _receive(self, handle: Handle) -> bytes:
        """See `read`."""

    @abstractmethod
    def _send(self, handle: Handle, data: bytes) -> None:
        """See `write`."""

    @abstractmethod
    def _release(self, handle: Handle) -> None:
        """Close what `_connect` gave."""


Transport = HandleTransport[Any]


def find_port(serial_number: str) -> str:
    """The port of the device with this serial number, whatever its name is today.

    Raises:
        DeviceError: no such device is plugged in (the message lists those that are), or several
            with this number.
    """
    from serial.tools import list_ports

    ports = list_ports.comports()
    found = sorted(port.device for port in ports if port.serial_number == serial_number)
    if len(found) == 1:
        return found[0]
    present = ", ".join(sorted(p.serial_number for p in ports if p.serial_number)) or "none"
    raise DeviceError(
        f"serial device {serial_number!r}: got {len(found)} devices with this number "
        f"({', '.join(found)}), expected one; name the port instead"
        if found
        else f"serial device {serial_number!r} is not plugged in; present: {present}",
        serial_number=serial_number,
    )


class SerialTransport(HandleTransport["serial.Serial"]):
    """One serial port, held exclusively; a write takes 0.5 s at most.

    `find` gives the port's name at every opening, so that a replugged device is found again; USB
    devices ignore the baud rate.
    """

    advice = "is it unplugged, in use, or not allowed for this user (`dextouch doctor`)?"

    def __init__(
        self,
        find: Callable[[], str],
        *,
        baud_rate: int = 2_000_000,
        serial_number: str | None = None,
    ) -> None:
        super().__init__(TransportInfo("serial", "not opened", serial_number))
        self._find = find
        self._baud_rate = baud_rate
        self._closing: threading.Thread | None = None
        self._poll = select.poll()

    def _connect(self) -> "serial.Serial":
        """Find and open the port; its input buffer is cleared."""
        import serial

        if self._closing is not None and self._closing.is_alive():
            raise DeviceError(
                f"{self.info}: is still being closed, because the device does not read; wait half "
                "a minute or replug it"
            )
        # The port of now, for messages.
        self.info = replace(self.info, address=self._find())
        try:
            port = serial.Serial(
                self.info.address,
                self._baud_rate,
                timeout=READ_TIMEOUT_S,
                write_timeout=WRITE_TIMEOUT_S,
                exclusive=True,
            )
        except ValueError as error:
            raise OSError(error) from error
        # USB bridges of one maker hold bytes back for 16 ms unless told otherwise; now is the time,
        # since doing it in full flow stalls them. Ports without such a timer refuse.
        with contextlib.suppress(OSError, ValueError):
            port.set_low_latency_mode(True)
        self._poll = select.poll()
        self._poll.register(port.fileno(), select.POLLIN)
        return port

    def _receive(self, handle: "serial.Serial") -> bytes:
        # The wait has its own bound: one left to the line ends only if nobody changes its settings.
        if not self._poll.poll(READ_TIMEOUT_S * 1e3):
            return b""
        try:
            data = os.read(handle.fileno(), SERIAL_READ_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError("end of file")
        return data

    def _send(self, handle: "serial.Serial", data: bytes) -> None:
        try:
            handle.write(data)
        except (TypeError, ValueError) as error:
            # pyserial fails with these where another thread closes the port meanwhile.
            raise OSError(error) from error

    def _release(self, handle: "serial.Serial") -> None:
        """Close the port; what takes longer than 1 s goes on by itself, and is said."""
        self._closing = threading.Thread(
            target=self._give_back, args=(handle,), name="close-serial", daemon=True
        )
        self._closing.start()
        self._closing.join(CLOSE_TIMEOUT_S)
        if self._closing.is_alive():
            logger.warning("wait_for_port_to_close", address=self.info.address)

    def _give_back(self, port: "serial.Serial") -> None:
        try:
            port.close()
        except OSError as error:
            logger.warning("fail_to_close_port", address=self.info.address, error=str(error))


@dataclass(frozen=True)
class UsbAddress:
    """Which device: its ids and, where several are alike, its serial number."""

    vendor_id: int
    product_id: int
    serial_number: str | None = None

    def __str__(self) -> str:
        return f"{self.vendor_id:04x}:{self.product_id:04x}"


def open_hid(address: UsbAddress) -> HidDevice:
    """Open the real device of these ids (hidraw; the libusb backend detaches other users)."""
    import hidraw

    device = hidraw.device()
    device.open(address.vendor_id, address.product_id, address.serial_number)
    return device


class HidTransport(HandleTransport[HidDevice]):
    """One HID device; `read` gives one report, and b"" means nothing yet (never: stale)."""

    def __init__(
        self,
        open_device: Callable[[], HidDevice],
        *,
        address: str,
        serial_number: str | None = None,
    ) -> None:
        super().__init__(TransportInfo("hid", address, serial_number))
        self._open_device = open_device

    def _connect(self) -> HidDevice:
        return self._open_device()

    def _receive(self, handle: HidDevice) -> bytes:
        return bytes(handle.read(REPORT_BYTES, round(READ_TIMEOUT_S * 1e3)))

    def _send(self, handle: HidDevice, data: bytes) -> None:
        written = handle.write(data)
        if written < len(data):
            raise DeviceError(f"{self.info}: wrote {written} bytes, expected at least {len(data)}")

    def _release(self, handle: HidDevice) -> None:
        handle.close()


class SocketTransport(HandleTransport[socket.socket]):
    """One stream socket, reconnected at every opening."""

    advice = "is the device or bridge there, and does it listen?"

    def __init__(self, connect: Callable[[], socket.socket], *, address: str) -> None:
        super().__init__(TransportInfo("socket", address))
        self._dial = connect

    def _connect(self) -> socket.socket:
        link = self._dial()
        link.settimeout(READ_TIMEOUT_S)
        return link

    def _receive(self, handle: socket.socket) -> bytes:
        try:
            data = handle.recv(READ_BYTES)
        except TimeoutError:
            return b""
        if not data:
            raise DeviceError(f"{self.info}: closed by the device")
        return data

    def _send(self, handle: socket.socket, data: bytes) -> None:
        handle.sendall(data)

    def _release(self, handle: socket.socket) -> None:
        handle.close()


def tcp_transport(host: str, port: int) -> SocketTransport:
    """The connection to a device or bridge at `host:port`, not opened."""

    def connect() -> socket.socket:
        link = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT_S)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return link

    return SocketTransport(connect, address=f"{host}:{port}")


def unix_transport(path: str) -> SocketTransport:
    """The connection to a bridge on this machine by its socket's path, not opened."""

    def connect() -> socket.socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        link.settimeout(CONNECT_TIMEOUT_S)
        try:
            link.connect(path)
        except OSError:
            link.close()
            raise
        return link

    return SocketTransport(connect, address=path)


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

    Without a `backend` there is a new context of libusb at every opening: an older one learns of
    what is plugged in only by udev, which does not speak inside containers.
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

        ids = {"idVendor": self._address.vendor_id, "idProduct": self._address.product_id}
        found = usb.core.find(find_all=True, backend=self._context, **ids)
        candidates = [(device, _serial_number(device)) for device in found]
        serial_number = self._address.serial_number
        matching = [device for device, number in candidates if serial_number in {None, number}]
        for device, _ in candidates:
            if matching != [device]:
                usb.util.dispose_resources(device)
        if len(matching) == 1:
            return matching[0]
        present = ", ".join(number or "(unreadable)" for _, number in candidates) or "none"
        if matching:
            raise DeviceError(
                f"{self.info}: {len(matching)} devices match; set serial_number to one of: "
                f"{present}"
            )
        raise DeviceError(
            f"{self.info}: device {serial_number or 'of these ids'!r} is not plugged in; present: "
            f"{present}",
            serial_number=serial_number,
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
