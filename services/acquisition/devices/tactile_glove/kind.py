"""The kind `tactile_glove`: our own glove."""

from typing import Literal

from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.serial_line import GloveSettings, serial_transport
from services.acquisition.devices.tactile_glove.driver import TactileGlove


class TactileGloveSettings(GloveSettings):
    """Our glove on a serial line.

    With serial number and port, the port is opened and the glove there must say that it has the
    number. `protocol` has this one value; older settings named other gloves by it.
    """

    kind: Literal["tactile_glove"] = "tactile_glove"
    protocol: Literal["dextouch"] = "dextouch"


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
