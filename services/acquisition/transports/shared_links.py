"""What a device shares with others on its way to this computer: USB hub, network or program."""

import re
from pathlib import Path

from dextouch.schemas import SharedLink
from services.acquisition.transports.ports import TransportInfo

SYSFS = Path("/sys/class")
# Kernel classes of the device files that transports open.
CLASSES = ("tty", "video4linux", "hidraw")
# A port of a hub in sysfs: bus, then ports from the root on, as in 1-2.4.
_USB_PORT = re.compile(r"^\d+-\d+(?:\.\d+)*$")
_LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1", "[::1]"})


def shared_link(info: TransportInfo, *, sysfs: Path = SYSFS) -> SharedLink | None:
    """The hub, remote host or local program that a transport leads through.

    None where it is plugged into this computer directly, or where nothing is known.

    Args:
        info: where the transport leads now.
        sysfs: folder of the kernel's device classes.
    """
    if info.kind == "socket":
        return _of_socket(info.address)
    hub = _usb_hub(info.address, sysfs) if info.address.startswith("/dev/") else None
    return None if hub is None else SharedLink(kind="hub", name=hub)


def _of_socket(address: str) -> SharedLink | None:
    if address.startswith("/"):
        return SharedLink(kind="bridge", name=address)
    host, separator, port = address.rpartition(":")
    if not separator or not port.isdecimal():
        return None
    if host in _LOOPBACK:
        return SharedLink(kind="bridge", name=address)
    return SharedLink(kind="network", name=host)


def _usb_hub(address: str, sysfs: Path) -> str | None:
    """Path of the hub above a device file, such as 1-2; None for a port of the root hub."""
    name = Path(address).resolve().name
    for kind in CLASSES:
        link = sysfs / kind / name / "device"
        if link.exists():
            ports = [part for part in link.resolve().parts if _USB_PORT.match(part)]
            return ports[-1].rpartition(".")[0] or None if ports else None
    return None
