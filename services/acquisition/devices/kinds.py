"""Kinds of devices: what a kind is, how it is found by its name, and the drivers of a station.

Every other module of this package holds the `KIND` of one of ours, with or without an installation.
"""

import pkgutil
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar, get_args

from pydantic import Field, TypeAdapter, model_validator

from dextouch.errors import DexTouchError, InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Matrix
from dextouch.tactile.layout import Side, TactileLayout, read_layout
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver, hand_name
from services.acquisition.hid_process import HidProcessTransport
from services.acquisition.transports import (
    SerialTransport,
    Transport,
    UsbAddress,
    UsbTransport,
    find_port,
    tcp_transport,
    unix_transport,
)

ENTRY_POINT_GROUP = "dextouch.devices"
OWN_PACKAGE = "dextouch-wm"
NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
# What the import of another package's module may end in.
IMPORT_FAILURES = (
    ImportError,
    AttributeError,
    SyntaxError,
    NameError,
    TypeError,
    ValueError,
    LookupError,
    ArithmeticError,
    AssertionError,
    OSError,
    RuntimeError,
    DexTouchError,
)
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
            does. It takes a `MockSlot` and gives a `MockPair` (`services.acquisition.mocks`). It
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
    `layout` is the file with the layout of its taxels (docs/stations.md#layout-of-a-glove); by
    default they are those of `dextouch_v1`.
    """

    side: Side
    label: str | None = Field(default=None, pattern=r"^[a-z0-9][a-z0-9_]{0,31}$")
    layout: Path | None = None

    def read_layout(self) -> TactileLayout | None:
        """Layout of the file; None where the settings name none.

        Raises:
            NotFoundError, StorageError, LimitExceededError, InvalidInputError: as
                `dextouch.tactile.read_layout`.
        """
        return None if self.layout is None else read_layout(self.layout)

    @property
    def device(self) -> str:
        """The name of the device."""
        return f"glove_{hand_name(self.side, self.label)}"


def serial_transport(settings: SerialLineSettings, *, device: str) -> SerialTransport:
    """The line to a device, not opened.

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
    """The link to a tracker or to the bridge of its SDK, not opened."""
    if settings.path is not None:
        return unix_transport(settings.path)
    if settings.port is not None:
        return tcp_transport(settings.host, settings.port)
    # Validated: without a bridge there are both ids.
    address = UsbAddress(settings.vendor_id or 0, settings.product_id or 0, settings.serial_number)
    return UsbTransport(address) if settings.link == "usb" else HidProcessTransport(address)


_MATRICES = TypeAdapter(dict[str, Matrix])


def kind_names() -> list[str]:
    """Names of all kinds that a station's settings can name here, loaded or not."""
    return sorted({point.name for point in _points(tuple(sys.path))})


def device_kind(name: str) -> DeviceKind[Any]:
    """The kind of this name; its package is imported now, if it was not before.

    Raises:
        UnknownNameError: no package brings it.
        InvalidInputError: several do, or the one that does is broken.
    """
    found = [point for point in _points(tuple(sys.path)) if point.name == name]
    if not found:
        raise UnknownNameError("kind of device", name, kind_names())
    if len(found) > 1:
        packages = ", ".join(f"{_package_of(point)} ({point.value})" for point in found)
        raise InvalidInputError(
            f"kind of device {name!r}: got {len(found)} packages that provide it, {packages}; "
            f"expected one: uninstall the others, or rename their entry points of the group "
            f"{ENTRY_POINT_GROUP!r}"
        )
    return _load(found[0])


def _package_of(point: EntryPoint) -> str:
    return OWN_PACKAGE if point.dist is None else point.dist.name


@lru_cache(maxsize=4)
def _points(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Ours, then those of installed packages; looking through the folders of `path` takes 0.1 s."""
    ours = [
        EntryPoint(module.name, f"{__package__}.{module.name}:KIND", ENTRY_POINT_GROUP)
        for module in pkgutil.iter_modules([str(Path(__file__).parent)])
        if module.name != Path(__file__).stem
    ]
    others = {(point.name, point.value): point for point in entry_points(group=ENTRY_POINT_GROUP)}
    return (*ours, *others.values())


def _load(point: EntryPoint) -> DeviceKind[Any]:
    """Refuse what cannot be imported, or is no `DeviceKind` with this name."""
    try:
        loaded: object = point.load()
    except IMPORT_FAILURES as error:
        got = f"{type(error).__name__}: {error}"
        raise _wrong(point, got, "a module that can be imported") from error
    if not isinstance(loaded, DeviceKind):
        raise _wrong(point, f"{type(loaded).__name__}", "a services.acquisition.devices.DeviceKind")
    if loaded.name != point.name or not NAME.fullmatch(loaded.name):
        raise _wrong(point, f"a kind named {loaded.name!r}", f"the entry point's name {point.name}")
    if not (isinstance(loaded.settings, type) and issubclass(loaded.settings, DeviceSettings)):
        raise _wrong(point, f"settings {loaded.settings!r}", "a class derived from DeviceSettings")
    kind = loaded.settings.model_fields["kind"].annotation
    if get_args(kind) != (loaded.name,):
        expected = f'kind: Literal["{loaded.name}"] = "{loaded.name}"'
        raise _wrong(point, f"settings whose kind is {kind}", expected)
    if not callable(loaded.build):
        raise _wrong(point, f"build = {loaded.build!r}", "a function of settings and clock")
    return loaded


def _wrong(point: EntryPoint, got: str, expected: str) -> InvalidInputError:
    package = _package_of(point)
    return InvalidInputError(
        f"kind of device {point.name!r} of package {package} (entry point {point.value} of group "
        f"{ENTRY_POINT_GROUP}): got {got}, expected {expected}; fix or uninstall package {package}"
    )


def chosen_device(value: object) -> DeviceSettings:
    """Settings of a device by the kind that they name; ValueError says what is wrong."""
    if isinstance(value, DeviceSettings):
        return value
    if not isinstance(value, Mapping) or not isinstance(value.get("kind"), str):
        raise ValueError(  # noqa: TRY004 - pydantic gathers ValueErrors of all devices
            f"got {value!r}, expected a map that names its kind: {', '.join(kind_names())}"
        )
    try:
        settings = device_kind(value["kind"]).settings
    except InvalidInputError as error:
        raise ValueError(error.message) from error
    return settings.model_validate(value)


def build_drivers(devices: Sequence[DeviceSettings], clock: StationClock) -> list[Driver]:
    """One driver a device.

    Raises:
        InvalidInputError: two devices of the same name or with the same stream, or none at all.
    """
    drivers = [_build(device, clock) for device in devices]
    names = [driver.name for driver in drivers]
    if not names or len(set(names)) < len(names):
        raise InvalidInputError(
            f"station: got devices {names}, expected at least one and no two alike; "
            "set DEXTOUCH_ACQUISITION_DEVICES or DEXTOUCH_ACQUISITION_MOCK"
        )
    owners: dict[str, str] = {}
    for driver in drivers:
        for descriptor in driver.descriptors:
            owner = owners.setdefault(descriptor.name, driver.name)
            if owner != driver.name:
                raise InvalidInputError(
                    f"station: stream {descriptor.name!r} is given by {owner!r} and by "
                    f"{driver.name!r}, expected one device a stream; leave one of them out, or "
                    "name the streams that robot_state shall give (`streams`)"
                )
    return drivers


def _build(device: DeviceSettings, clock: StationClock) -> Driver:
    kind = device_kind(device.kind)
    driver: object = kind.build(device, clock)
    if not isinstance(driver, Driver):
        raise InvalidInputError(
            f"kind of device {kind.name!r}: build gave {type(driver).__name__}, expected a "
            "services.acquisition.devices.Driver; fix the package that provides this kind"
        )
    return driver


def load_calibration(path: Path | None) -> dict[str, Matrix]:
    """Named matrices of a JSON file; none without a file.

    Raises:
        InvalidInputError: the file cannot be read or holds something else.
    """
    if path is None:
        return {}
    try:
        return _MATRICES.validate_json(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"calibration {path}: no JSON of matrices ({error})") from error
