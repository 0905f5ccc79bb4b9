"""The kind `station_camera`."""

from collections.abc import Callable
from functools import partial

from dextouch.errors import InvalidInputError
from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.station_camera.capture import (
    NS_PER_MS,
    CaptureLink,
    CaptureRequest,
    OpenCvCapture,
    find_camera,
)
from services.acquisition.devices.station_camera.driver import CameraTiming, StationCamera
from services.acquisition.devices.station_camera.settings import StationCameraSettings


def build(settings: StationCameraSettings, clock: StationClock) -> StationCamera:
    """The driver of one camera.

    Raises:
        InvalidInputError: neither serial number nor device.
    """
    find, address = _finder(settings)
    request = CaptureRequest(
        height_px=settings.height_px,
        width_px=settings.width_px,
        rate_hz=settings.rate_hz,
        fourcc=settings.fourcc,
        exposure_ns=_nanoseconds(settings.exposure_ms),
    )
    link = CaptureLink(
        lambda: OpenCvCapture(find(), request),
        address=address,
        serial_number=settings.serial_number,
    )
    timing = CameraTiming(
        stamp_point=settings.stamp_point,
        latency_ns=_nanoseconds(settings.latency_ms),
        latency_sigma_ns=_nanoseconds(settings.latency_sigma_ms),
    )
    return StationCamera(
        settings.stream,
        link=link,
        request=request,
        encoding=settings.encoding,
        clock=clock,
        timing=timing,
    )


def _finder(settings: StationCameraSettings) -> tuple[Callable[[], str], str]:
    """What finds the camera at every opening, and how it is called in messages."""
    if settings.serial_number is not None:
        return partial(find_camera, settings.serial_number), settings.serial_number
    if settings.device is not None:
        return partial(str, settings.device), settings.device
    raise InvalidInputError(f"camera {settings.stream}: set its serial_number or its device")


def _nanoseconds(milliseconds: float | None) -> int | None:
    return None if milliseconds is None else round(milliseconds * NS_PER_MS)


KIND = DeviceKind(name="station_camera", settings=StationCameraSettings, build=build)
