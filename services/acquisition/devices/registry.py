"""Finds kinds of devices by name, and builds the drivers that a station's settings name.

Kinds of this package and of others are entry points of one group and are loaded by the same code,
when a station names them. Every folder beside this file is one of ours, with or without an
installation: its `driver` holds `KIND`.
"""

import pkgutil
import re
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import BeforeValidator, SerializeAsAny, TypeAdapter

from dextouch.errors import DexTouchError, InvalidInputError, UnknownNameError
from dextouch.schemas import Matrix
from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind, DeviceSettings
from services.acquisition.drivers.base import Driver

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
        EntryPoint(folder.name, f"{__package__}.{folder.name}.driver:KIND", ENTRY_POINT_GROUP)
        for folder in pkgutil.iter_modules([str(Path(__file__).parent)])
        if folder.ispkg
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


def _validated(value: object) -> DeviceSettings:
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


ChosenDevice = Annotated[SerializeAsAny[DeviceSettings], BeforeValidator(_validated)]


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
        return _MATRICES.validate_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"calibration {path}: no JSON of matrices ({error})") from error
