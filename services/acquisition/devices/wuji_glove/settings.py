"""Settings of a Wuji glove."""

from typing import Literal

from services.acquisition.devices.gloves import GloveSettings


class WujiGloveSettings(GloveSettings):
    """A Wuji glove on a serial line; it tells which hand it is for."""

    kind: Literal["wuji_glove"] = "wuji_glove"
