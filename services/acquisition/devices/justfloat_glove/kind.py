"""The kind `justfloat_glove`."""

from services.acquisition.clock import StationClock
from services.acquisition.devices.justfloat_glove.packets import JustFloatGloveDecoder
from services.acquisition.devices.justfloat_glove.settings import JustFloatGloveSettings
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.serial_line import serial_transport
from services.acquisition.drivers.base import Driver


def build(settings: JustFloatGloveSettings, clock: StationClock) -> Driver:
    """The driver of one glove."""
    transport = serial_transport(settings, device=settings.device)
    decoder = JustFloatGloveDecoder(
        settings.side,
        num_values=settings.num_values,
        full_scale=settings.full_scale,
        rate_hz=settings.rate_hz,
        label=settings.label,
    )
    return Driver(settings.device, transport=transport, decoder=decoder, clock=clock)


KIND = DeviceKind(
    name="justfloat_glove",
    settings=JustFloatGloveSettings,
    build=build,
    mock="services.acquisition.devices.justfloat_glove.mock:mock_justfloat_glove",
)
