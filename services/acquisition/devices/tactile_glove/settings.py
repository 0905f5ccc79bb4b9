"""Settings of our own tactile glove."""

from typing import Literal

from services.acquisition.devices.gloves import GloveSettings


class TactileGloveSettings(GloveSettings):
    """Our glove on a serial line.

    With serial number and port, the port is opened and the glove there must say that it has the
    number. `protocol` has this one value; older settings named other gloves by it.
    """

    kind: Literal["tactile_glove"] = "tactile_glove"
    protocol: Literal["dextouch"] = "dextouch"
