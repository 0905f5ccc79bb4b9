"""Definition of a kind of device for a station, and the base class of its settings."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import Field, model_validator

from dextouch.errors import InvalidInputError
from dextouch.frozen_model import FrozenModel
from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver, hand_name
from services.acquisition.transports.ports import (
    HidTransport,
    SerialTransport,
    Transport,
    find_port,
    hid_opener,
    tcp_transport,
    unix_transport,
)
from services.acquisition.transports.usb import UsbAddress, UsbTransport

# Names of streams are ROLE_LABEL or ROLE_LABEL_SIDE; the role says what reads them.
StreamName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,63}$")]
# `camera_head` is what episodes need; any number of others may stand beside it.
CameraStream = Annotated[str, Field(pattern=r"^camera_[a-z0-9_]{1,57}$")]


class DeviceSettings(FrozenModel):
    """Settings of one device of a station; every kind derives its own class.

    `kind` names the kind. A derived class narrows it to that name and makes it the default:
    `kind: Literal["wuji_glove"] = "wuji_glove"`. Unknown keys are refused.
    """

    kind: str


class TcpSettings(DeviceSettings):
    """A device at a TCP address."""

    host: str = "127.0.0.1"
    port: int = Field(gt=0, le=65535)


SettingsT = TypeVar("SettingsT", bound=DeviceSettings)


@dataclass(frozen=True)
class DeviceKind(Generic[SettingsT]):
    """One kind of device: how it is called, configured, read and simulated.

    Our own kinds and those of other packages are found by the entry point `dextouch.devices`, whose
    name is that of the kind. The decoder of a glove provides its `cells`, so that health checks
    treat real and simulated gloves alike.

    Attributes:
        name: the value of `kind` in a station's settings: a-z, 0-9 and `_`.
        settings: the class that validates the rest of them.
        build: makes the driver, not opened yet, from the settings and the station's clock. It
            raises InvalidInputError where the settings do not say where the device is.
        mock: where a function is that simulates the device, as "module:function"; None if nothing
            does. It takes a `MockPlace` and gives a `MockPair` (`services.acquisition.mocks`). It
            is imported in mock stations only: drivers never import mocks.
    """

    name: str
    settings: type[SettingsT]
    build: Callable[[SettingsT, StationClock], Driver]
    mock: str | None = None


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


class TrackerSettings(DeviceSettings):
    """How a tracker is reached.

    By `hid` or `usb` it is found by its ids and, where several are alike, its serial number; by
    `bridge` it is asked for at the socket of its SDK's process: `path` of a local socket, or `host`
    and `port`.
    """

    link: Literal["hid", "usb", "bridge"] = "hid"
    vendor_id: int | None = Field(default=None, ge=0, le=0xFFFF)
    product_id: int | None = Field(default=None, ge=0, le=0xFFFF)
    serial_number: str | None = None
    host: str = "127.0.0.1"
    port: int | None = Field(default=None, gt=0, le=65535)
    path: str | None = None

    @model_validator(mode="after")
    def _address_of_its_link(self) -> "TrackerSettings":
        num_ids = sum(number is not None for number in (self.vendor_id, self.product_id))
        num_ends = sum(end is not None for end in (self.port, self.path))
        if (num_ids, num_ends) != ((0, 1) if self.link == "bridge" else (2, 0)):
            raise ValueError(
                f"link {self.link!r}: got vendor_id {self.vendor_id}, product_id "
                f"{self.product_id}, port {self.port}, path {self.path}; expected both ids (hid, "
                "usb), or else a port or a path (bridge)"
            )
        return self


def tracker_transport(settings: TrackerSettings) -> Transport:
    """The link to a tracker or to the bridge of its SDK, not opened.

    Raises:
        InvalidInputError: settings that were never validated, without any address.
    """
    if settings.path is not None:
        return unix_transport(settings.path)
    if settings.port is not None:
        return tcp_transport(settings.host, settings.port)
    if settings.vendor_id is None or settings.product_id is None:
        raise InvalidInputError(
            f"{settings.kind} by {settings.link}: set its vendor_id and product_id, or the port or "
            "path of its bridge"
        )
    address = UsbAddress(settings.vendor_id, settings.product_id, settings.serial_number)
    if settings.link == "usb":
        return UsbTransport(address)
    return HidTransport(
        hid_opener(
            vendor_id=settings.vendor_id,
            product_id=settings.product_id,
            serial_number=settings.serial_number,
        ),
        address=str(address),
        serial_number=settings.serial_number,
    )
