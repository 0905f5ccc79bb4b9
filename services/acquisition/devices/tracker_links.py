"""Trackers by HID, USB or the bridge to their SDK: the settings of the link, and its transport."""

from typing import Literal

from pydantic import Field, model_validator

from dextouch.errors import InvalidInputError
from services.acquisition.devices.kind import DeviceSettings
from services.acquisition.transports.base import Transport
from services.acquisition.transports.hid import HidTransport, hid_opener
from services.acquisition.transports.socket import tcp_transport, unix_transport
from services.acquisition.transports.usb import UsbAddress, UsbTransport


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
