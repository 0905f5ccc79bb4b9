"""The kind `wuji_glove`."""

from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.serial_line import serial_transport
from services.acquisition.devices.wuji_glove.packets import WujiGloveDecoder
from services.acquisition.devices.wuji_glove.settings import WujiGloveSettings
from services.acquisition.drivers.base import Driver


def build(settings: WujiGloveSettings, clock: StationClock) -> Driver:
    """The driver of one glove."""
    transport = serial_transport(settings, device=settings.device)
    decoder = WujiGloveDecoder(settings.side, label=settings.label)
    return Driver(settings.device, transport=transport, decoder=decoder, clock=clock)


KIND = DeviceKind(
    name="wuji_glove",
    settings=WujiGloveSettings,
    build=build,
    mock="services.acquisition.devices.wuji_glove.mock:mock_wuji_glove",
)
