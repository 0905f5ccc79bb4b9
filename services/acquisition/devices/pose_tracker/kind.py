"""The kind `pose_tracker`."""

from typing import Literal

from pydantic import field_validator

from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import DeviceKind, StreamName
from services.acquisition.devices.pose_tracker.bridge import BridgePoseTrackerDecoder
from services.acquisition.devices.pose_tracker.packets import PoseTrackerDecoder
from services.acquisition.devices.tracker_links import (
    TrackerSettings,
    tracker_transport,
)
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.sdk_link_driver import BridgeDriver

OTHER_ROLES = ("tactile_", "keypoints_", "camera_", "joints_", "action", "object_poses")


class PoseTrackerSettings(TrackerSettings):
    """A pose tracker on a wrist, on the head, or anywhere else (`elbow_left`, `object_cup`).

    The first three (`wrist_left`, `wrist_right`, `head`) are what episodes need; their trackers say
    where they sit, all others say nothing (`none`).
    """

    kind: Literal["pose_tracker"] = "pose_tracker"
    stream: StreamName

    @field_validator("stream")
    @classmethod
    def _is_no_other_role(cls, stream: str) -> str:
        if stream.startswith(OTHER_ROLES):
            raise ValueError(
                f"got {stream!r}, expected the name of a place or a thing; names that begin with "
                f"{', '.join(OTHER_ROLES)} are those of other kinds of streams"
            )
        return stream


def build(settings: PoseTrackerSettings, clock: StationClock) -> Driver:
    """The driver of one tracker, by its link."""
    name = f"pose_tracker_{settings.stream}"
    transport = tracker_transport(settings)
    if settings.link == "bridge":
        bridged = BridgePoseTrackerDecoder(settings.stream, serial_number=settings.serial_number)
        return BridgeDriver(name, transport=transport, decoder=bridged, clock=clock)
    decoder = PoseTrackerDecoder(settings.stream)
    return Driver(name, transport=transport, decoder=decoder, clock=clock)


KIND = DeviceKind(name="pose_tracker", settings=PoseTrackerSettings, build=build)
