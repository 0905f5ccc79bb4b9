"""The kind `station_camera`."""

from collections.abc import Callable
from functools import partial

from dextouch.errors import InvalidInputError
from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.station_camera.capture import (
    CaptureLink,
    OpenCvCapture,
    find_camera,
)
from services.acquisition.devices.station_camera.driver import StationCamera
from services.acquisition.devices.station_camera.settings import StationCameraSettings


def build(settings: StationCameraSettings, clock: StationClock) -> StationCamera:
    """The driver of one camera.

    Raises:
        InvalidInputError: neither serial number nor device.
    """
    find, address = _finder(settings)
    link = CaptureLink(
        lambda: OpenCvCapture(find(), settings),
        address=address,
        serial_number=settings.serial_number,
    )
    return StationCamera(settings, link=link, clock=clock)


def _finder(settings: StationCameraSettings) -> tuple[Callable[[], str], str]:
    """What finds the camera at every opening, and how it is called in messages."""
    if settings.serial_number is not None:
        return partial(find_camera, settings.serial_number), settings.serial_number
    if settings.device is not None:
        return partial(str, settings.device), settings.device
    raise InvalidInputError(f"camera {settings.stream}: set its serial_number or its device")


KIND = DeviceKind(name="station_camera", settings=StationCameraSettings, build=build)
