"""State of the host as seen by a mock device: whether it listens, and has kept up."""

import threading
from collections.abc import Callable

from dextouch.errors import DeviceError
from services.acquisition.transports.ports import Transport, TransportInfo

KEEP_UP_TIMEOUT_S = 20.0


class Link:
    """State of the host's end as seen by a mock."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._ahead = 0
        self._is_open = False

    @property
    def is_open(self) -> bool:
        """Whether the host has opened the device."""
        return self._is_open

    def set_open(self, *, is_open: bool) -> None:
        """The host opens or closes."""
        with self._changed:
            self._is_open = is_open
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
        with self._changed:
            if not self._changed.wait_for(
                lambda: self._ahead <= 0 or not self._is_open, KEEP_UP_TIMEOUT_S
            ):
                raise DeviceError(f"mock device: the host left {self._ahead} bytes unread for 20 s")

    def wait_closed(self) -> None:
        """Block until the host has noticed that the device is gone.

        Raises:
            DeviceError: it does not for 20 s.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: not self._is_open, KEEP_UP_TIMEOUT_S):
                raise DeviceError("mock device: the host did not detect the unplugging for 20 s")


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
