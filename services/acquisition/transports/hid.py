"""Transport to a HID device by hidapi's hidraw backend."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from dextouch.errors import DeviceError
from services.acquisition.transports.base import HandleTransport, TransportInfo

READ_TIMEOUT_MS = 100
MAX_REPORT_BYTES = 64


@runtime_checkable
class HidDevice(Protocol):
    """What we use of an opened hidapi device."""

    def read(self, max_length: int, timeout_ms: int = 0) -> list[int]:
        """One report; [] when none has come yet; OSError when unplugged."""
        ...

    def write(self, buff: bytes) -> int:
        """Send a report, its id first; the number of bytes, or -1."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


def hid_opener(
    *, vendor_id: int, product_id: int, serial_number: str | None = None
) -> Callable[[], HidDevice]:
    """What opens the real device of these ids (hidraw; the libusb backend detaches other users)."""

    def open_device() -> HidDevice:
        import hidraw

        device = hidraw.device()
        device.open(vendor_id, product_id, serial_number)
        return device

    return open_device


class HidTransport(HandleTransport[HidDevice]):
    """One HID device; `read` gives one report, and b"" means nothing yet (never: stale)."""

    def __init__(
        self,
        open_device: Callable[[], HidDevice],
        *,
        address: str,
        serial_number: str | None = None,
    ) -> None:
        super().__init__(TransportInfo("hid", address, serial_number))
        self._open_device = open_device

    def read(self) -> bytes:
        """One report, waiting up to 0.1 s.

        Raises:
            DeviceError: the device is gone.
        """
        try:
            return bytes(self._opened().read(MAX_REPORT_BYTES, READ_TIMEOUT_MS))
        except OSError as error:
            raise DeviceError(f"{self.info}: unplugged while reading ({error})") from error

    def write(self, data: bytes) -> None:
        """Send one report; its first byte is the report id.

        Raises:
            DeviceError: the device is gone or takes no such report.
        """
        try:
            written = self._opened().write(data)
        except OSError as error:
            raise DeviceError(f"{self.info}: unplugged while writing ({error})") from error
        if written < len(data):
            raise DeviceError(f"{self.info}: wrote {written} bytes, expected at least {len(data)}")

    def _connect(self) -> HidDevice:
        try:
            return self._open_device()
        except OSError as error:
            raise DeviceError(
                f"{self.info}: cannot be opened ({error}); plugged in, and allowed by udev?"
            ) from error

    def _release(self, handle: HidDevice) -> None:
        handle.close()
