"""The kind `tactile_glove`: our own glove."""

from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.serial_line import serial_transport
from services.acquisition.devices.tactile_glove.driver import TactileGlove
from services.acquisition.devices.tactile_glove.settings import TactileGloveSettings


def build(settings: TactileGloveSettings, clock: StationClock) -> TactileGlove:
    """The driver of one glove."""
    return TactileGlove(
        settings.side,
        transport=serial_transport(settings, device=settings.device),
        clock=clock,
        serial_number=settings.serial_number,
        label=settings.label,
    )


KIND = DeviceKind(
    name="tactile_glove",
    settings=TactileGloveSettings,
    build=build,
    mock="services.acquisition.devices.tactile_glove.mock:mock_glove",
)
