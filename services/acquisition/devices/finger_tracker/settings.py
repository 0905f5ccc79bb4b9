"""Settings of a finger tracker."""

from typing import Literal

from dextouch.tactile.layout import Side
from services.acquisition.devices.tracker_links import TrackerSettings


class FingerTrackerSettings(TrackerSettings):
    """A finger tracker of one hand."""

    kind: Literal["finger_tracker"] = "finger_tracker"
    side: Side
