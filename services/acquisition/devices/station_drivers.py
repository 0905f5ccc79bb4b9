"""The drivers of a station's devices and its calibration, made from its settings."""

import json
from collections.abc import Sequence
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from dextouch.errors import InvalidInputError
from dextouch.schemas import Matrix
from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceSettings
from services.acquisition.devices.registry import device_kind
from services.acquisition.drivers.base import Driver

_MATRICES = TypeAdapter(dict[str, Matrix])


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
    _refuse_shared_streams(drivers)
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


def _refuse_shared_streams(drivers: Sequence[Driver]) -> None:
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


def load_calibration(path: Path | None) -> dict[str, Matrix]:
    """Named matrices of a JSON file; none without a file.

    Raises:
        InvalidInputError: the file cannot be read or holds something else.
    """
    if path is None:
        return {}
    try:
        return _MATRICES.validate_python(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, ValidationError) as error:
        raise InvalidInputError(f"calibration {path}: no JSON of matrices ({error})") from error
