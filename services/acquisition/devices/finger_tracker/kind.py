"""The kind `finger_tracker`."""

from typing import Literal

from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.devices.finger_tracker.bridge import BridgeFingerTrackerDecoder
from services.acquisition.devices.finger_tracker.driver import FingerTracker
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.tracker_links import (
    TrackerSettings,
    tracker_transport,
)
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.sdk_link_driver import BridgeDriver


class FingerTrackerSettings(TrackerSettings):
    """A finger tracker of one hand."""

    kind: Literal["finger_tracker"] = "finger_tracker"
    side: Side


def build(settings: FingerTrackerSettings, clock: StationClock) -> Driver:
    """The driver of one tracker, by its link."""
    name = f"finger_tracker_{settings.side}"
    transport = tracker_transport(settings)
    if settings.link == "bridge":
        decoder = BridgeFingerTrackerDecoder(settings.side, serial_number=settings.serial_number)
        return BridgeDriver(name, transport=transport, decoder=decoder, clock=clock)
    return FingerTracker(name, settings.side, transport=transport, clock=clock)


KIND = DeviceKind(name="finger_tracker", settings=FingerTrackerSettings, build=build)
