"""The kind `pose_tracker`."""

from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind
from services.acquisition.devices.pose_tracker.bridge import BridgePoseTrackerDecoder
from services.acquisition.devices.pose_tracker.packets import PoseTrackerDecoder
from services.acquisition.devices.pose_tracker.settings import PoseTrackerSettings
from services.acquisition.devices.tracker_links import bridge_transport, report_transport
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.sdk_link_driver import BridgeDriver


def build(settings: PoseTrackerSettings, clock: StationClock) -> Driver:
    """The driver of one tracker, by its link."""
    name = f"pose_tracker_{settings.stream}"
    if settings.link == "bridge":
        bridged = BridgePoseTrackerDecoder(settings.stream, serial_number=settings.serial_number)
        return BridgeDriver(
            name, transport=bridge_transport(settings), decoder=bridged, clock=clock
        )
    decoder = PoseTrackerDecoder(settings.stream)
    return Driver(name, transport=report_transport(settings), decoder=decoder, clock=clock)


KIND = DeviceKind(name="pose_tracker", settings=PoseTrackerSettings, build=build)
