"""Settings of a glove that sends bare float32s."""

from typing import Literal

from pydantic import Field

from services.acquisition.devices.gloves import GloveSettings


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
