"""Transport to a serial port by pyserial, found by its name or a serial number."""

import contextlib
import os
import select
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import structlog

from dextouch.errors import DeviceError
from services.acquisition.transports.base import HandleTransport, TransportInfo

if TYPE_CHECKING:
    import serial

logger = structlog.get_logger(__name__)

READ_TIMEOUT_S = 0.1
# A device that takes nothing in must not hold up the station for ever.
WRITE_TIMEOUT_S = 0.5
# The kernel keeps a closing port for up to 30 s while the device takes nothing in; only root may
# shorten that.
CLOSE_TIMEOUT_S = 1.0
# More than a kernel buffer holds: one read takes all that has come.
READ_BYTES = 65_536


def find_port(serial_number: str) -> str:
    """The port of the device with this serial number, whatever its name is today.

    Raises:
        DeviceError: no such device is plugged in (the message lists those that are), or several
            with this number.
    """
    from serial.tools import list_ports

    ports = list_ports.comports()
    found = sorted(port.device for port in ports if port.serial_number == serial_number)
    if not found:
        present = ", ".join(sorted(p.serial_number for p in ports if p.serial_number)) or "none"
        raise DeviceError(
            f"serial device {serial_number!r} is not plugged in; present: {present}",
            serial_number=serial_number,
        )
    if len(found) > 1:
        raise DeviceError(
            f"serial device {serial_number!r}: got {len(found)} devices with this number "
            f"({', '.join(found)}), expected one; name the port instead",
            serial_number=serial_number,
        )
    return found[0]


class SerialTransport(HandleTransport["serial.Serial"]):
    """One serial port, held exclusively.

    Args:
        find: gives the port's name at every opening, so that a replugged device is found again.
        baud_rate: bits per second (USB devices ignore it).
        serial_number: of the device, for messages.
    """

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

    def read(self) -> bytes:
        """All that has arrived, waiting up to 0.1 s for the first byte.

        Raises:
            DeviceError: the port is closed or the device is gone.
        """
        port = self._opened()
        # The wait has its own bound: one left to the line ends only if nobody changes its settings.
        if not self._poll.poll(READ_TIMEOUT_S * 1e3):
            return b""
        try:
            data = os.read(port.fileno(), READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise DeviceError(f"{self.info}: unplugged while reading ({error})") from error
        if not data:
            raise DeviceError(f"{self.info}: unplugged while reading (end of file)")
        return data

    def write(self, data: bytes) -> None:
        """Send all bytes, within 0.5 s.

        Raises:
            DeviceError: the port is closed, the device is gone or takes nothing in.
        """
        try:
            self._opened().write(data)
        except (OSError, TypeError, ValueError) as error:
            # pyserial fails with the latter two where another thread closes the port meanwhile.
            raise DeviceError(f"{self.info}: lost while writing ({error})") from error

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
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise DeviceError(f"{self.info}: cannot be opened ({error}); is it in use?") from error
        # USB bridges of one maker hold bytes back for 16 ms unless told otherwise; now is the time,
        # since doing it in full flow stalls them. Ports without such a timer refuse.
        with contextlib.suppress(OSError, ValueError):
            port.set_low_latency_mode(True)
        self._poll = select.poll()
        self._poll.register(port.fileno(), select.POLLIN)
        return port

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
