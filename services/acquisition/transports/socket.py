"""Transport over a stream socket; the far end closing it is a loss of the device."""

import socket
from collections.abc import Callable

from dextouch.errors import DeviceError
from services.acquisition.transports.base import TransportInfo

READ_TIMEOUT_S = 0.1
CONNECT_TIMEOUT_S = 2.0
READ_BYTES = 1 << 18


def tcp_connector(host: str, port: int) -> Callable[[], socket.socket]:
    """What connects to a device or bridge at `host:port`."""

    def connect() -> socket.socket:
        link = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT_S)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return link

    return connect


def unix_connector(path: str) -> Callable[[], socket.socket]:
    """What connects to a bridge on this machine by its socket's path."""

    def connect() -> socket.socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        link.settimeout(CONNECT_TIMEOUT_S)
        try:
            link.connect(path)
        except OSError:
            link.close()
            raise
        return link

    return connect


class SocketTransport:
    """One stream socket, reconnected at every opening."""

    def __init__(self, connect: Callable[[], socket.socket], *, address: str) -> None:
        self._connect = connect
        self._address = address
        self._socket: socket.socket | None = None

    @property
    def info(self) -> TransportInfo:
        """The address."""
        return TransportInfo("socket", self._address)

    def open(self) -> None:
        """Connect.

        Raises:
            DeviceError: nobody answers.
        """
        self.close()
        try:
            self._socket = self._connect()
        except OSError as error:
            raise DeviceError(f"{self.info}: cannot connect ({error})") from error
        self._socket.settimeout(READ_TIMEOUT_S)

    def read(self) -> bytes:
        """All that has arrived, waiting up to 0.1 s for the first byte.

        Raises:
            DeviceError: the far end is gone.
        """
        try:
            data = self._opened().recv(READ_BYTES)
        except TimeoutError:
            return b""
        except OSError as error:
            raise DeviceError(f"{self.info}: lost while reading ({error})") from error
        if not data:
            raise DeviceError(f"{self.info}: closed by the device")
        return data

    def write(self, data: bytes) -> None:
        """Send all bytes.

        Raises:
            DeviceError: the far end is gone.
        """
        try:
            self._opened().sendall(data)
        except OSError as error:
            raise DeviceError(f"{self.info}: lost while writing ({error})") from error

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise DeviceError(f"{self.info}: not open")
        return self._socket
