"""Settings of real devices come in; their drivers, not yet opened, go out."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from dextouch.errors import InvalidInputError
from dextouch.schemas.episodes import Matrix
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.camera import CameraDecoder
from services.acquisition.drivers.finger_tracker import FingerTracker
from services.acquisition.drivers.pose_tracker import PoseTrackerDecoder
from services.acquisition.drivers.robot_state import RobotStateDecoder
from services.acquisition.drivers.tactile_glove import TactileGloveDecoder
from services.acquisition.settings import (
    CameraSettings,
    DeviceSettings,
    FingerTrackerSettings,
    PoseTrackerSettings,
    RobotStateSettings,
    TactileGloveSettings,
)
from services.acquisition.transports.hid import HidTransport, hid_opener
from services.acquisition.transports.serial import SerialTransport, find_port
from services.acquisition.transports.socket import SocketTransport, tcp_connector

_MATRICES = TypeAdapter(dict[str, Matrix])


def build_drivers(devices: Sequence[DeviceSettings], clock: StationClock) -> list[Driver]:
    """One driver a device.

    Raises:
        InvalidInputError: two devices of the same name, or none at all.
    """
    drivers = [_build(device, clock) for device in devices]
    names = [driver.name for driver in drivers]
    if not names or len(set(names)) < len(names):
        raise InvalidInputError(
            f"station: got devices {names}, expected at least one and no two alike; "
            "set DEXTOUCH_ACQUISITION_DEVICES or DEXTOUCH_ACQUISITION_MOCK"
        )
    return drivers


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


def _build(device: DeviceSettings, clock: StationClock) -> Driver:
    if isinstance(device, TactileGloveSettings):
        return _glove(device, clock)
    if isinstance(device, FingerTrackerSettings):
        name = f"finger_tracker_{device.side}"
        return FingerTracker(name, device.side, transport=_hid(device), clock=clock)
    if isinstance(device, PoseTrackerSettings):
        decoder = PoseTrackerDecoder(device.stream)
        name = f"pose_tracker_{device.stream}"
        return Driver(name, transport=_hid(device), decoder=decoder, clock=clock)
    if isinstance(device, CameraSettings):
        camera = CameraDecoder(
            device.stream,
            height_px=device.height_px,
            width_px=device.width_px,
            encoding=device.encoding,
        )
        return Driver(device.stream, transport=_tcp(device), decoder=camera, clock=clock)
    return Driver("robot_state", transport=_tcp(device), decoder=RobotStateDecoder(), clock=clock)


def _glove(device: TactileGloveSettings, clock: StationClock) -> Driver:
    find: Callable[[], str]
    if device.serial_number is not None:
        find = partial(find_port, device.serial_number)
    elif device.port is not None:
        find = partial(str, device.port)
    else:
        raise InvalidInputError(f"glove {device.side}: set its serial_number or its port")
    transport = SerialTransport(
        find, baud_rate=device.baud_rate, serial_number=device.serial_number
    )
    decoder = TactileGloveDecoder(device.side)
    return Driver(f"glove_{device.side}", transport=transport, decoder=decoder, clock=clock)


def _hid(device: FingerTrackerSettings | PoseTrackerSettings) -> HidTransport:
    return HidTransport(
        hid_opener(
            vendor_id=device.vendor_id,
            product_id=device.product_id,
            serial_number=device.serial_number,
        ),
        address=f"{device.vendor_id:04x}:{device.product_id:04x}",
        serial_number=device.serial_number,
    )


def _tcp(device: CameraSettings | RobotStateSettings) -> SocketTransport:
    address = f"{device.host}:{device.port}"
    return SocketTransport(tcp_connector(device.host, device.port), address=address)
