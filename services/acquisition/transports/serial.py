"""A serial port by pyserial: a port name or a device's serial number comes in, bytes go out."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from dextouch.errors import DeviceError
from services.acquisition.transports.base import TransportInfo

if TYPE_CHECKING:
    import serial

READ_TIMEOUT_S = 0.1


def find_port(serial_number: str) -> str:
    """The port of the device with this serial number, whatever its name is today.

    Raises:
        DeviceError: no such device is plugged in; the message lists those that are.
    """
    from serial.tools import list_ports

    found = {port.serial_number: port.device for port in list_ports.comports()}
    if serial_number not in found:
        present = ", ".join(sorted(str(number) for number in found if number)) or "none"
        raise DeviceError(
            f"serial device {serial_number!r} is not plugged in; present: {present}",
            serial_number=serial_number,
        )
    return found[serial_number]


class SerialTransport:
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
        self._find = find
        self._baud_rate = baud_rate
        self._serial_number = serial_number
        self._address = "not opened"
        self._port: serial.Serial | None = None

    @property
    def info(self) -> TransportInfo:
        """The port last opened."""
        return TransportInfo("serial", self._address, self._serial_number)

    def open(self) -> None:
        """Find and open the port; what lay in its buffer is dropped.

        Raises:
            DeviceError: absent, taken by another process, or not to be opened.
        """
        import serial

        self.close()
        self._address = self._find()
        try:
            self._port = serial.Serial(
                self._address, self._baud_rate, timeout=READ_TIMEOUT_S, exclusive=True
            )
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise DeviceError(f"{self.info}: cannot be opened ({error}); is it in use?") from error

    def read(self) -> bytes:
        """All that has arrived, waiting up to 0.1 s for the first byte.

        Raises:
            DeviceError: the port is closed or the device is gone.
        """
        port = self._opened()
        try:
            return port.read(max(1, port.in_waiting))
        except OSError as error:  # SerialException is an OSError
            raise DeviceError(f"{self.info}: unplugged while reading ({error})") from error

    def write(self, data: bytes) -> None:
        """Send all bytes.

        Raises:
            DeviceError: the port is closed or the device is gone.
        """
        try:
            self._opened().write(data)
        except OSError as error:
            raise DeviceError(f"{self.info}: lost while writing ({error})") from error

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _opened(self) -> "serial.Serial":
        if self._port is None:
            raise DeviceError(f"{self.info}: not open")
        return self._port
