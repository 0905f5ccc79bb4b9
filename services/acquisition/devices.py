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
from services.acquisition.drivers.bridge_tracker import (
    BridgeDriver,
    BridgeFingerTrackerDecoder,
    BridgePoseTrackerDecoder,
)
from services.acquisition.drivers.camera import CameraDecoder, CameraDriver
from services.acquisition.drivers.finger_tracker import FingerTracker
from services.acquisition.drivers.glove_driver import TactileGlove
from services.acquisition.drivers.glove_protocols import vendor_glove_decoder
from services.acquisition.drivers.pose_tracker import PoseTrackerDecoder
from services.acquisition.drivers.robot_state import RobotStateDecoder
from services.acquisition.drivers.station_camera import CameraTiming, StationCamera
from services.acquisition.drivers.video_capture import (
    NS_PER_MS,
    CaptureLink,
    CaptureRequest,
    OpenCvCapture,
    find_camera,
)
from services.acquisition.settings import (
    CameraSettings,
    DeviceSettings,
    FingerTrackerSettings,
    PoseTrackerSettings,
    RobotStateSettings,
    StationCameraSettings,
    TactileGloveSettings,
)
from services.acquisition.transports.base import Transport
from services.acquisition.transports.hid import HidTransport, hid_opener
from services.acquisition.transports.serial import SerialTransport, find_port
from services.acquisition.transports.socket import (
    SocketTransport,
    tcp_connector,
    unix_connector,
)
from services.acquisition.transports.usb import UsbAddress, UsbTransport

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


def _build(device: DeviceSettings, clock: StationClock) -> Driver:
    if isinstance(device, TactileGloveSettings):
        return _glove(device, clock)
    if isinstance(device, FingerTrackerSettings):
        return _finger_tracker(device, clock)
    if isinstance(device, PoseTrackerSettings):
        return _pose_tracker(device, clock)
    if isinstance(device, CameraSettings):
        camera = CameraDecoder(
            device.stream,
            height_px=device.height_px,
            width_px=device.width_px,
            encoding=device.encoding,
        )
        return CameraDriver(device.stream, transport=_tcp(device), decoder=camera, clock=clock)
    if isinstance(device, StationCameraSettings):
        return _station_camera(device, clock)
    robot = RobotStateDecoder(device.streams)
    return Driver("robot_state", transport=_tcp(device), decoder=robot, clock=clock)


def _station_camera(device: StationCameraSettings, clock: StationClock) -> StationCamera:
    find: Callable[[], str]
    if device.serial_number is not None:
        find, address = partial(find_camera, device.serial_number), device.serial_number
    elif device.device is not None:
        find, address = partial(str, device.device), device.device
    else:
        raise InvalidInputError(f"camera {device.stream}: set its serial_number or its device")
    request = CaptureRequest(
        height_px=device.height_px,
        width_px=device.width_px,
        rate_hz=device.rate_hz,
        fourcc=device.fourcc,
        exposure_ns=_nanoseconds(device.exposure_ms),
    )
    link = CaptureLink(
        lambda: OpenCvCapture(find(), request),
        address=address,
        serial_number=device.serial_number,
    )
    timing = CameraTiming(
        stamp_point=device.stamp_point,
        latency_ns=_nanoseconds(device.latency_ms),
        latency_sigma_ns=_nanoseconds(device.latency_sigma_ms),
    )
    return StationCamera(
        device.stream,
        link=link,
        request=request,
        encoding=device.encoding,
        clock=clock,
        timing=timing,
    )


def _nanoseconds(milliseconds: float | None) -> int | None:
    return None if milliseconds is None else round(milliseconds * NS_PER_MS)


def _glove(device: TactileGloveSettings, clock: StationClock) -> Driver:
    find: Callable[[], str]
    if device.port is not None:
        find = partial(str, device.port)
    elif device.serial_number is not None:
        find = partial(find_port, device.serial_number)
    else:
        raise InvalidInputError(f"glove {device.side}: set its serial_number or its port")
    transport = SerialTransport(
        find, baud_rate=device.baud_rate, serial_number=device.serial_number
    )
    if device.protocol == "dextouch":
        return TactileGlove(
            device.side, transport=transport, clock=clock, serial_number=device.serial_number
        )
    decoder = vendor_glove_decoder(
        device.protocol,
        device.side,
        num_values=device.num_values,
        full_scale=device.full_scale,
        rate_hz=device.rate_hz,
    )
    return Driver(f"glove_{device.side}", transport=transport, decoder=decoder, clock=clock)


def _finger_tracker(device: FingerTrackerSettings, clock: StationClock) -> Driver:
    name = f"finger_tracker_{device.side}"
    if device.link == "bridge":
        decoder = BridgeFingerTrackerDecoder(device.side, serial_number=device.serial_number)
        return BridgeDriver(name, transport=_bridge(device), decoder=decoder, clock=clock)
    return FingerTracker(name, device.side, transport=_reports(device), clock=clock)


def _pose_tracker(device: PoseTrackerSettings, clock: StationClock) -> Driver:
    name = f"pose_tracker_{device.stream}"
    if device.link == "bridge":
        bridged = BridgePoseTrackerDecoder(device.stream, serial_number=device.serial_number)
        return BridgeDriver(name, transport=_bridge(device), decoder=bridged, clock=clock)
    decoder = PoseTrackerDecoder(device.stream)
    return Driver(name, transport=_reports(device), decoder=decoder, clock=clock)


def _reports(device: FingerTrackerSettings | PoseTrackerSettings) -> Transport:
    if device.vendor_id is None or device.product_id is None:
        raise InvalidInputError(f"{device.kind} by {device.link}: set its vendor_id and product_id")
    address = UsbAddress(device.vendor_id, device.product_id, device.serial_number)
    if device.link == "usb":
        return UsbTransport(address)
    return HidTransport(
        hid_opener(
            vendor_id=device.vendor_id,
            product_id=device.product_id,
            serial_number=device.serial_number,
        ),
        address=str(address),
        serial_number=device.serial_number,
    )


def _bridge(device: FingerTrackerSettings | PoseTrackerSettings) -> SocketTransport:
    if device.path is not None:
        return SocketTransport(unix_connector(device.path), address=device.path)
    if device.port is None:
        raise InvalidInputError(f"{device.kind} by bridge: set its port or its path")
    address = f"{device.host}:{device.port}"
    return SocketTransport(tcp_connector(device.host, device.port), address=address)


def _tcp(device: CameraSettings | RobotStateSettings) -> SocketTransport:
    address = f"{device.host}:{device.port}"
    return SocketTransport(tcp_connector(device.host, device.port), address=address)
