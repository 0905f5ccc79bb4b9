"""Devices on serial lines: the settings that find one, and the transport to it."""

from collections.abc import Callable
from functools import partial

from pydantic import Field

from dextouch.errors import InvalidInputError
from services.acquisition.devices.kind import DeviceSettings
from services.acquisition.transports.serial import SerialTransport, find_port


class SerialLineSettings(DeviceSettings):
    """A device on a serial line, found by its serial number or by the name of its port.

    With both, the port is opened.
    """

    serial_number: str | None = None
    port: str | None = None
    baud_rate: int = Field(default=2_000_000, gt=0)


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
