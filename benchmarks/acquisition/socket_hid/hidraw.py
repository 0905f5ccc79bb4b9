"""Stand-in for hidapi's module `hidraw`, whose devices are sockets; first in the import path.

The serial number of a device is the path of its socket. The socket's queue plays that of the
kernel, see `benchmarks.acquisition.starved.SocketHid`.
"""

import socket
import struct

# struct timeval of SO_RCVTIMEO: the wait and the read are one call without the interpreter's lock,
# as in hidapi.
_TIMEVAL = struct.Struct("@ll")


class device:  # noqa: N801 - hidapi's name
    """An opened device: the methods of hidapi's that we use."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._timeout_ms = 0

    def open(self, vendor_id: int, product_id: int, serial_number: str) -> None:
        """Connect to the socket; its ids do not matter."""
        try:
            self._socket.connect(serial_number)
            self._socket.recv(1)  # the device queues reports from now on
        except OSError as error:
            self.close()
            raise OSError("open failed") from error

    def read(self, max_length: int, timeout_ms: int) -> list[int]:
        """One report, or [] where none comes in time."""
        if timeout_ms != self._timeout_ms:
            timeval = _TIMEVAL.pack(timeout_ms // 1000, timeout_ms % 1000 * 1000)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeval)
            self._timeout_ms = timeout_ms
        try:
            data = self._socket.recv(max_length)
        except BlockingIOError:
            return []
        if not data:
            raise OSError("read error")
        return list(data)

    def write(self, data: bytes) -> int:
        """One report to the device."""
        return self._socket.send(data)

    def close(self) -> None:
        """Give the device back."""
        self._socket.close()
