"""The device's end of a pseudo terminal, HID device or socket with a real transport behind it."""

import contextlib
import errno
import os
import select
import socket
import threading
import tty
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import ClassVar

from dextouch.errors import DeviceError
from services.acquisition import transports

# A host that is merely busy loses nothing, as behind a real device with buffers of its own.
SEND_TIMEOUT_S = 20.0
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


class WatchedTransport(transports.HandleTransport[transports.Transport]):
    """The host's transport, telling the mock how far the host is.

    What a read returned counts as processed when the reader comes back for more: by then it has
    been stamped, decoded and recorded.

    `on_write` takes how many bytes the host has just written, in the host's thread.
    """

    def __init__(
        self,
        transport: transports.Transport,
        link: Link,
        *,
        on_open: Callable[[], None] | None = None,
        on_write: Callable[[int], None] | None = None,
    ) -> None:
        super().__init__(transport.info)
        self._transport = transport
        self._link = link
        self._on_open = on_open
        self._on_write = on_write
        self._pending = 0

    def _connect(self) -> transports.Transport:
        self._transport.open()
        self.info = self._transport.info
        self._pending = 0
        self._link.set_open(is_open=True)
        if self._on_open is not None:
            self._on_open()
        return self._transport

    def _receive(self, handle: transports.Transport) -> bytes:
        self._link.add_consumed(self._pending)
        self._pending = 0
        data = handle.read()
        self._pending = len(data)
        return data

    def _send(self, handle: transports.Transport, data: bytes) -> None:
        handle.write(data)
        if self._on_write is not None:
            self._on_write(len(data))

    def _release(self, handle: transports.Transport) -> None:
        handle.close()
        self._link.set_open(is_open=False)


class MockPort(ABC):
    """The device's end of a link, with the host's end as `transport`."""

    has_bit_errors: ClassVar[bool] = False
    transport: transports.Transport

    def __init__(self) -> None:
        self.link = Link()

    @abstractmethod
    def send(self, unit: bytes) -> bool:
        """Send bytes or one report; False when the host's buffer was full."""

    @abstractmethod
    def plug(self) -> None:
        """Become visible to the host."""

    @abstractmethod
    def unplug(self) -> None:
        """Vanish."""


class PtyPort(MockPort):
    """A serial device: a pseudo terminal with a new name at every plugging.

    The name is also its serial number.
    """

    has_bit_errors = True

    def __init__(self, name: str, answer: Answer | None = None) -> None:
        super().__init__()
        self._name = name
        self._answer = answer
        self._master: int | None = None
        self._slave: int | None = None
        self._sending = threading.Lock()
        self.transport = WatchedTransport(
            transports.SerialTransport(self._find, serial_number=name),
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


class ReportPort(MockPort):
    """A device of reports or images, of which the host's library keeps the first unread ones."""

    max_reports: ClassVar[int]

    def __init__(self) -> None:
        super().__init__()
        self.is_plugged = False
        self._reports: deque[bytes] = deque()
        self._changed = threading.Condition()

    def plug(self) -> None:
        """Plug in."""
        self._set_plugged(plugged=True)

    def unplug(self) -> None:
        """Pull out: a waiting host notices at once."""
        self._set_plugged(plugged=False)

    def send(self, unit: bytes) -> bool:
        """A report into the buffer; False when as many wait as it can keep."""
        with self._changed:
            if not self.is_plugged or len(self._reports) >= self.max_reports:
                return False
            self.link.add_sent(len(unit))
            self._reports.append(unit)
            self._changed.notify_all()
            return True

    def flush(self) -> None:
        """Forget unread reports."""
        with self._changed:
            self._reports.clear()

    def fetch(self, timeout_s: float) -> bytes:
        """The oldest report; b"" when none comes in time.

        Raises:
            OSError: unplugged.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._reports or not self.is_plugged, timeout_s)
            self.check_plugged()
            return self._reports.popleft() if self._reports else b""

    def check_plugged(self) -> None:
        """Fail as the host's library does with a device that has gone.

        Raises:
            OSError: unplugged.
        """
        if not self.is_plugged:
            raise OSError(errno.EIO, "read error")

    def _set_plugged(self, *, plugged: bool) -> None:
        with self._changed:
            self.is_plugged = plugged
            self._changed.notify_all()


class HidPort(ReportPort):
    """A HID device whose host end is the real HID transport, for which it is hidapi.

    `read` gives [] when idle and OSError when unplugged; a ring keeps 63 reports and silently
    loses the newest; `write` counts one byte more than it was given.
    """

    max_reports = 63

    def __init__(self, name: str, answer: Answer | None = None) -> None:
        super().__init__()
        self._answer = answer
        transport = transports.HidTransport(self.open, address=f"mock:{name}", serial_number=name)
        self.transport = WatchedTransport(transport, self.link)

    def open(self) -> "HidPort":
        """What hidapi's open does: reports that came before are not seen."""
        self.check_plugged()
        self.flush()
        return self

    def read(self, max_length: int, timeout_ms: int = 0) -> list[int]:
        """One report or []."""
        return list(self.fetch(timeout_ms / 1000)[:max_length])

    def write(self, buff: bytes) -> int:
        """A report to the device, which answers in the host's thread."""
        self.check_plugged()
        for unit in self._answer(bytes(buff)) if self._answer is not None else []:
            self.send(unit)
        return len(buff) + 1

    def close(self) -> None:
        """Nothing is held."""


class SocketPort(MockPort):
    """A device behind a socket: every connection of the host is a new pair."""

    def __init__(self, name: str, on_open: Callable[[], None] | None = None) -> None:
        super().__init__()
        self._plugged = False
        self._device_end: socket.socket | None = None
        transport = transports.SocketTransport(self._connect, address=f"mock:{name}")
        self.transport = WatchedTransport(transport, self.link, on_open=on_open)

    def plug(self) -> None:
        """Accept connections."""
        self._plugged = True

    def unplug(self) -> None:
        """Close the connection and refuse new ones."""
        self._plugged = False
        end, self._device_end = self._device_end, None
        if end is not None:
            end.close()

    def send(self, unit: bytes) -> bool:
        """Send all; a host that takes nothing for 20 s loses it."""
        end = self._device_end
        if end is None:
            return False
        self.link.add_sent(len(unit))
        try:
            end.sendall(unit)
        except OSError:
            self.link.add_sent(-len(unit))
            return False
        return True

    def _connect(self) -> socket.socket:
        if not self._plugged:
            raise ConnectionRefusedError(errno.ECONNREFUSED, "the mock device is unplugged")
        before, (end, host_end) = self._device_end, socket.socketpair()
        if before is not None:
            with contextlib.suppress(OSError):
                before.close()
        end.settimeout(SEND_TIMEOUT_S)
        self._device_end = end
        return host_end
