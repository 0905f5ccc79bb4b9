"""The kind `justfloat_glove`."""

from typing import Literal

from pydantic import Field

from services.acquisition.clock import StationClock
from services.acquisition.devices.justfloat_glove.packets import JustFloatGloveDecoder
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.serial_line import GloveSettings, serial_transport
from services.acquisition.drivers.base import Driver


class JustFloatGloveSettings(GloveSettings):
    """Settings of a glove on a serial port whose packets do not describe themselves.

    Attributes:
        num_values: float32s of a packet.
        full_scale: the largest reading.
        rate_hz: nominal rate.
    """

    kind: Literal["justfloat_glove"] = "justfloat_glove"
    num_values: int = Field(ge=1, le=4096)
    full_scale: float = Field(gt=0, le=1e30)
    rate_hz: float = Field(gt=0, le=10_000)


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
