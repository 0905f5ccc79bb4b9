"""Transport over a stream socket; the far end closing it is a loss of the device."""

import socket
from collections.abc import Callable

from dextouch.errors import DeviceError
from services.acquisition.transports.base import HandleTransport, TransportInfo

READ_TIMEOUT_S = 0.1
CONNECT_TIMEOUT_S = 2.0
READ_BYTES = 1 << 18


class SocketTransport(HandleTransport[socket.socket]):
    """One stream socket, reconnected at every opening."""

    def __init__(self, connect: Callable[[], socket.socket], *, address: str) -> None:
        super().__init__(TransportInfo("socket", address))
        self._dial = connect

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

    def _connect(self) -> socket.socket:
        try:
            link = self._dial()
        except OSError as error:
            raise DeviceError(f"{self.info}: cannot connect ({error})") from error
        link.settimeout(READ_TIMEOUT_S)
        return link

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
