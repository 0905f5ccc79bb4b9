"""The interface that a driver needs of a port; every failure of the link is an error."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, runtime_checkable

from dextouch.errors import DeviceError

Handle = TypeVar("Handle")


@dataclass(frozen=True)
class TransportInfo:
    """Where a transport leads, for messages and the dashboard."""

    kind: str
    address: str
    serial_number: str | None = None

    def __str__(self) -> str:
        return f"{self.kind} {self.address}"


@runtime_checkable
class Transport(Protocol):
    """A way to one device. Every failure of the link is a DeviceError."""

    @property
    def info(self) -> TransportInfo:
        """Where it leads."""
        ...

    def open(self) -> None:
        """Open the link; an open one is closed first."""
        ...

    def read(self) -> bytes:
        """What has arrived, waiting a moment for the first byte; b"" means: nothing yet."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        ...

    def close(self) -> None:
        """Close the link; closing twice is fine."""
        ...


class HandleTransport(ABC, Generic[Handle]):
    """Base of transports over what a library opens: a port, a device, a socket, a camera.

    Args:
        info: where it leads.
    """

    def __init__(self, info: TransportInfo) -> None:
        self.info = info
        self._handle: Handle | None = None

    def open(self) -> None:
        """Find and open the device; an open one is closed first.

        Raises:
            DeviceError: absent, taken by another process, not permitted, or not to be opened.
        """
        self.close()
        self._handle = self._connect()

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
    def _release(self, handle: Handle) -> None:
        """Close what `_connect` gave."""
