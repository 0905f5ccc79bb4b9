"""The kind `camera`."""

from typing import Literal

from pydantic import Field

from services.acquisition.clock import StationClock
from services.acquisition.devices.camera.driver import CameraDecoder, CameraDriver
from services.acquisition.devices.kind import CameraStream, DeviceKind, TcpSettings
from services.acquisition.transports.socket import tcp_transport


class CameraSettings(TcpSettings):
    """A camera bridge at a TCP address."""

    kind: Literal["camera"] = "camera"
    stream: CameraStream
    height_px: int = Field(default=480, gt=0)
    width_px: int = Field(default=640, gt=0)
    encoding: Literal["rgb8", "jpeg", "h264"] = "jpeg"


def build(settings: CameraSettings, clock: StationClock) -> CameraDriver:
    """The driver of one bridge."""
    decoder = CameraDecoder(
        settings.stream,
        height_px=settings.height_px,
        width_px=settings.width_px,
        encoding=settings.encoding,
    )
    return CameraDriver(
        settings.stream,
        transport=tcp_transport(settings.host, settings.port),
        decoder=decoder,
        clock=clock,
    )


KIND = DeviceKind(name="camera", settings=CameraSettings, build=build)
