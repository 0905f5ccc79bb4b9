"""Settings that all gloves on serial lines share: the line, the hand, and a label of one's own."""

from pydantic import Field

from dextouch.tactile.layout import Side
from services.acquisition.devices.serial_line import SerialLineSettings
from services.acquisition.drivers.base import hand_name


class GloveSettings(SerialLineSettings):
    """A glove of one hand.

    Without a label it gives the stream that episodes need (`tactile_left`). With one it is a
    further glove or patch of cells; its stream (`tactile_left_LABEL`) and calibration are named so.
    """

    side: Side
    label: str | None = Field(default=None, pattern=r"^[a-z0-9][a-z0-9_]{0,31}$")

    @property
    def device(self) -> str:
        """The name of the device."""
        return f"glove_{hand_name(self.side, self.label)}"
