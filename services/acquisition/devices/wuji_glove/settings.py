"""Settings of a Wuji glove."""

from typing import Literal

from dextouch.tactile.layout import Side
from services.acquisition.devices.serial_line import SerialLineSettings


class WujiGloveSettings(SerialLineSettings):
    """A Wuji glove on a serial line; it tells which hand it is for."""

    kind: Literal["wuji_glove"] = "wuji_glove"
    side: Side
