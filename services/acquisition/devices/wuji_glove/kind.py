"""The kind `wuji_glove`."""

from typing import Literal

from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.serial_line import GloveSettings, serial_transport
from services.acquisition.devices.wuji_glove.packets import WujiGloveDecoder
from services.acquisition.drivers.base import Driver


class WujiGloveSettings(GloveSettings):
    """A Wuji glove on a serial line; its packets contain the hand."""

    kind: Literal["wuji_glove"] = "wuji_glove"


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
