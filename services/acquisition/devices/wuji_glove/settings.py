"""Settings of a Wuji glove."""

from typing import Literal

from services.acquisition.devices.gloves import GloveSettings


class WujiGloveSettings(GloveSettings):
    """A Wuji glove on a serial line; its packets contain the hand."""

    kind: Literal["wuji_glove"] = "wuji_glove"
