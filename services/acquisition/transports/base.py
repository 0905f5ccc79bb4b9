"""The interface that a driver needs of a port; every failure of the link is an error."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable


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
