"""Devices on serial lines, gloves above all: their settings, and the transport to them."""

from collections.abc import Callable
from functools import partial

from pydantic import Field

from dextouch.errors import InvalidInputError
from dextouch.tactile.layout import Side
from services.acquisition.devices.kind import DeviceSettings
from services.acquisition.drivers.base import hand_name
from services.acquisition.transports.serial import SerialTransport, find_port


class SerialLineSettings(DeviceSettings):
    """A device on a serial line, found by its serial number or by the name of its port.

    With both, the port is opened.
    """

    serial_number: str | None = None
    port: str | None = None
    baud_rate: int = Field(default=2_000_000, gt=0)


class GloveSettings(SerialLineSettings):
    """A glove of one hand.

    Without a label it gives the stream that episodes need (`tactile_left`). With one it is a
    further glove or patch of cells; its stream (`tactile_left_LABEL`) and calibration are named so.
    """

    side: Side
    label: str | None = Field(default=None, pattern=r"^[a-z0-9][a-z0-9_]{0,31}$")

    @property
    def device(self) -> str:
        """The name of the device."""
        return f"glove_{hand_name(self.side, self.label)}"


def serial_transport(settings: SerialLineSettings, *, device: str) -> SerialTransport:
    """The line to a device, not opened.

    Args:
        settings: where it is.
        device: for messages.

    Raises:
        InvalidInputError: neither serial number nor port.
    """
    find: Callable[[], str]
    if settings.port is not None:
        find = partial(str, settings.port)
    elif settings.serial_number is not None:
        find = partial(find_port, settings.serial_number)
    else:
        raise InvalidInputError(f"{device}: set its serial_number or its port")
    return SerialTransport(find, baud_rate=settings.baud_rate, serial_number=settings.serial_number)
