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
from services.acquisition.transports.ports import (
    HidDevice,
    HidTransport,
    SerialTransport,
    SocketTransport,
    Transport,
    TransportInfo,
)

# A host that is merely busy loses nothing, as behind a real device with buffers of its own.
SEND_TIMEOUT_S = 20.0
HID_RING_REPORTS = 63
# What a device says to what the host writes.
Answer = Callable[[bytes], list[bytes]]


class Link:
    """State of the host's end as seen by a mock: `is_open` once the host has opened the device."""

    def __init__(self) -> None:
        self.is_open = False
        self._changed = threading.Condition()
        self._ahead = 0

    def set_open(self, *, is_open: bool) -> None:
        """The host opens or closes."""
        with self._changed:
            self.is_open = is_open
            self._ahead = 0
            self._changed.notify_all()

    def add_sent(self, num_bytes: int) -> None:
        """The device sends."""
        with self._changed:
            self._ahead += num_bytes

    def add_consumed(self, num_bytes: int) -> None:
        """The host has read, stamped and processed."""
        with self._changed:
            self._ahead -= num_bytes
            self._changed.notify_all()

    def wait_consumed(self) -> None:
        """Block until the host has processed everything, or closed.

        Raises:
            DeviceError: it does neither for 20 s.
        """
        self._wait(lambda: self._ahead <= 0, "left {ahead} bytes unread")

    def wait_closed(self) -> None:
        """Block until the host has noticed that the device is gone.

        Raises:
            DeviceError: it does not for 20 s.
        """
        self._wait(lambda: False, "did not detect the unplugging")

    def _wait(self, is_done: Callable[[], bool], failing: str) -> None:
        with self._changed:
            if not self._changed.wait_for(lambda: is_done() or not self.is_open, SEND_TIMEOUT_S):
                text = failing.format(ahead=self._ahead)
                raise DeviceError(f"mock device: the host {text} for {SEND_TIMEOUT_S:.0f} s")


class WatchedTransport:
    """The host's transport, telling the mock how far the host is.

    What a read returned counts as processed when the reader comes back for more: by then it has
    been stamped, decoded and recorded.

    Args:
        transport: the host's end.
        link: of the mock.
        on_open: called when the host has opened the device.
        on_write: takes how many bytes the host has just written, in the host's thread.
    """

    def __init__(
        self,
        transport: Transport,
        link: Link,
        *,
        on_open: Callable[[], None] | None = None,
        on_write: Callable[[int], None] | None = None,
    ) -> None:
        self._transport = transport
        self._link = link
        self._on_open = on_open
        self._on_write = on_write
        self._pending = 0

    @property
    def info(self) -> TransportInfo:
        """Where it leads."""
        return self._transport.info

    def open(self) -> None:
        """Open and tell."""
        self._transport.open()
        self._pending = 0
        self._link.set_open(is_open=True)
        if self._on_open is not None:
            self._on_open()

    def read(self) -> bytes:
        """Tell, then read."""
        self._link.add_consumed(self._pending)
        self._pending = 0
        data = self._transport.read()
        self._pending = len(data)
        return data

    def write(self, data: bytes) -> None:
        """Write, and tell."""
        self._transport.write(data)
        if self._on_write is not None:
            self._on_write(len(data))

    def close(self) -> None:
        """Close and tell."""
        self._transport.close()
        self._link.set_open(is_open=False)


@runtime_checkable
class MockPort(Protocol):
    """The device's end; `has_bit_errors` where no checksum below ours guards the line."""

    link: Link
    has_bit_errors: bool

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

    def __init__(self, name: str, answer: Answer | None = None) -> None:
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

    def __init__(self, device: ReportDevice, transport: Transport, answer: Answer | None) -> None:
        self.link = Link()
        self.device = device
        self._answer = answer
        if answer is not None:
            device.on_write = self._hear
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

    def _hear(self, report: bytes) -> None:
        for unit in self._answer(report) if self._answer is not None else []:
            self.send(unit)


class HidPort(ReportPort):
    """A HID device whose host end is the real HID transport on a `FakeHid`."""

    def __init__(self, name: str, answer: Answer | None = None) -> None:
        device = FakeHid()
        transport = HidTransport(device.open, address=f"mock:{name}", serial_number=name)
        super().__init__(device, transport, answer)


class SocketPort:
    """A device behind a socket: every connection of the host is a new pair.

    Args:
        name: of the device.
        on_open: called when the host has connected.
    """

    has_bit_errors = False

    def __init__(self, name: str, on_open: Callable[[], None] | None = None) -> None:
        self.link = Link()
        self._plugged = False
        self._device_end: socket.socket | None = None
        transport = SocketTransport(self._connect, address=f"mock:{name}")
        self.transport = WatchedTransport(transport, self.link, on_open=on_open)

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
