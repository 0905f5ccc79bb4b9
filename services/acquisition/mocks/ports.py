"""The device's end of a pseudo terminal, HID device or socket with a real transport behind it."""

import contextlib
import errno
import os
import select
import socket
import threading
import tty
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, runtime_checkable

from dextouch.errors import DeviceError
from services.acquisition.mocks.link import KEEP_UP_TIMEOUT_S, Link, WatchedTransport
from services.acquisition.transports.ports import (
    HidDevice,
    HidTransport,
    SerialTransport,
    SocketTransport,
    Transport,
)

# A host that is merely busy loses nothing, as behind a real device with buffers of its own.
SEND_TIMEOUT_S = KEEP_UP_TIMEOUT_S
HID_RING_REPORTS = 63


@runtime_checkable
class MockPort(Protocol):
    """The device's end; `has_bit_errors` where no checksum below ours guards the line."""

    link: Link
    has_bit_errors: bool

    @property
    def transport(self) -> Transport:
        """The host's end, not opened."""
        ...

    def send(self, unit: bytes) -> bool:
        """Send bytes or one report; False when the host's buffer was full."""
        ...

    def plug(self) -> None:
        """Become visible to the host."""
        ...

    def unplug(self) -> None:
        """Vanish."""
        ...


class PtyPort:
    """A serial device: a pseudo terminal with a new name at every plugging.

    Args:
        name: of the device; also its serial number.
        answer: what the device says to the bytes that the host writes.
    """

    has_bit_errors = True

    def __init__(self, name: str, answer: Callable[[bytes], list[bytes]] | None = None) -> None:
        self.link = Link()
        self._name = name
        self._answer = answer
        self._master: int | None = None
        self._slave: int | None = None
        self._sending = threading.Lock()
        self.transport = WatchedTransport(
            SerialTransport(self._find, serial_number=name),
            self.link,
            on_write=None if answer is None else self._hear,
        )

    def plug(self) -> None:
        """Create the terminal."""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)

    def unplug(self) -> None:
        """Hang up."""
        with self._sending:
            for descriptor in (self._master, self._slave):
                if descriptor is not None:
                    os.close(descriptor)
            self._master = self._slave = None

    def send(self, unit: bytes) -> bool:
        """Write; what does not fit into the kernel's buffer within 20 s is lost."""
        rest = memoryview(unit)
        with self._sending:
            self.link.add_sent(len(unit))
            while rest and self._master is not None:
                if not select.select([], [self._master], [], SEND_TIMEOUT_S)[1]:
                    self.link.add_sent(-len(rest))
                    return False
                rest = rest[os.write(self._master, rest) :]
        return True

    def _find(self) -> str:
        if self._slave is None:
            raise DeviceError(f"serial device {self._name!r} is not plugged in")
        return os.ttyname(self._slave)

    def _hear(self, num_bytes: int) -> None:
        """Read what the host has just written, and answer (in the host's thread)."""
        data = b""
        with contextlib.suppress(OSError, ValueError):  # unplugged in the middle of it
            while len(data) < num_bytes and self._master is not None:
                if not select.select([self._master], [], [], SEND_TIMEOUT_S)[0]:
                    return
                data += os.read(self._master, num_bytes - len(data))
        for unit in self._answer(data) if self._answer is not None else []:
            self.send(unit)


@dataclass(kw_only=True)
class ReportDevice:
    """A model of a device behind a real library, which keeps some reports for its host.

    `on_write` takes the reports of the host.
    """

    max_reports: ClassVar[int]
    on_write: Callable[[bytes], None] | None = None
    is_plugged: bool = False
    _reports: deque[bytes] = field(default_factory=deque)
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def set_plugged(self, *, plugged: bool) -> None:
        """Plug it in or pull it out."""
        with self._changed:
            self.is_plugged = plugged
            self._changed.notify_all()

    def push(self, report: bytes) -> bool:
        """A report (or half of one) for the host; False when as many wait as it can keep."""
        with self._changed:
            if len(self._reports) >= self.max_reports:
                return False
            self._reports.append(report)
            self._changed.notify_all()
            return True

    def flush(self) -> None:
        """Forget unread reports."""
        with self._changed:
            self._reports.clear()


class FakeHid(ReportDevice):
    """Behaves like an opened hidapi device.

    `read` gives [] when idle and OSError when unplugged; a ring keeps 63 reports and silently
    loses the newest; `write` counts one byte more than it was given.
    """

    max_reports = HID_RING_REPORTS

    def open(self) -> HidDevice:
        """What hidapi's open does: reports that came before are not seen."""
        self._check()
        self.flush()
        return self

    def read(self, max_length: int, timeout_ms: int = 0) -> list[int]:
        """One report or []."""
        with self._changed:
            self._changed.wait_for(lambda: self._reports or not self.is_plugged, timeout_ms / 1000)
            self._check()
            return list(self._reports.popleft()[:max_length]) if self._reports else []

    def write(self, buff: bytes) -> int:
        """A report to the device."""
        self._check()
        if self.on_write is not None:
            self.on_write(bytes(buff))
        return len(buff) + 1

    def close(self) -> None:
        """Nothing is held."""

    def _check(self) -> None:
        if not self.is_plugged:
            raise OSError(errno.EIO, "read error")


class ReportPort:
    """A device of reports whose host end is a real transport.

    Args:
        device: the model that the transport's library is given.
        transport: the host's end, not opened.
        answer: what the device says to a report of the host.
    """

    has_bit_errors = False

    def __init__(
        self,
        device: ReportDevice,
        transport: Transport,
        answer: Callable[[bytes], list[bytes]] | None,
    ) -> None:
        self.link = Link()
        self.device = device
        if answer is not None:
            device.on_write = lambda report: self._send_all(answer(report))
        self.transport = WatchedTransport(transport, self.link)

    def plug(self) -> None:
        """Plug in."""
        self.device.set_plugged(plugged=True)

    def unplug(self) -> None:
        """Pull out."""
        self.device.set_plugged(plugged=False)

    def send(self, unit: bytes) -> bool:
        """A report into the device's buffer."""
        self.link.add_sent(len(unit))
        taken = self.device.push(unit)
        if not taken:
            self.link.add_sent(-len(unit))
        return taken

    def _send_all(self, reports: list[bytes]) -> None:
        for report in reports:
            self.send(report)


class HidPort(ReportPort):
    """A HID device whose host end is the real HID transport on a `FakeHid`."""

    def __init__(self, name: str, answer: Callable[[bytes], list[bytes]] | None = None) -> None:
        device = FakeHid()
        transport = HidTransport(device.open, address=f"mock:{name}", serial_number=name)
        super().__init__(device, transport, answer)


class SocketPort:
    """A device behind a socket: every connection of the host is a new pair."""

    has_bit_errors = False

    def __init__(self, name: str) -> None:
        self.link = Link()
        self._plugged = False
        self._device_end: socket.socket | None = None
        transport = SocketTransport(self._connect, address=f"mock:{name}")
        self.transport = WatchedTransport(transport, self.link, on_open=self._on_open)

    def plug(self) -> None:
        """Accept connections."""
        self._plugged = True

    def unplug(self) -> None:
        """Close the connection and refuse new ones."""
        self._plugged = False
        if self._device_end is not None:
            self._device_end.close()
            self._device_end = None

    def send(self, unit: bytes) -> bool:
        """Send all; a host that takes nothing for a second loses it."""
        if self._device_end is None:
            return False
        self.link.add_sent(len(unit))
        try:
            self._device_end.sendall(unit)
        except OSError:
            self.link.add_sent(-len(unit))
            return False
        return True

    def _connect(self) -> socket.socket:
        if not self._plugged:
            raise ConnectionRefusedError(errno.ECONNREFUSED, "the mock device is unplugged")
        if self._device_end is not None:
            with contextlib.suppress(OSError):
                self._device_end.close()
        self._device_end, host_end = socket.socketpair()
        self._device_end.settimeout(SEND_TIMEOUT_S)
        return host_end

    def _on_open(self) -> None:
        """The host has connected."""
