"""The kind `camera`."""

from services.acquisition.clock import StationClock
from services.acquisition.devices.camera.driver import CameraDecoder, CameraDriver
from services.acquisition.devices.camera.settings import CameraSettings
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.tcp import tcp_transport


def build(settings: CameraSettings, clock: StationClock) -> CameraDriver:
    """The driver of one bridge."""
    decoder = CameraDecoder(
        settings.stream,
        height_px=settings.height_px,
        width_px=settings.width_px,
        encoding=settings.encoding,
    )
    return CameraDriver(
        settings.stream, transport=tcp_transport(settings), decoder=decoder, clock=clock
    )


KIND = DeviceKind(name="camera", settings=CameraSettings, build=build)
