"""Settings of a pose tracker."""

from typing import Literal

from services.acquisition.devices.tracker_links import TrackerSettings


class PoseTrackerSettings(TrackerSettings):
    """A pose tracker on a wrist or on the head."""

    kind: Literal["pose_tracker"] = "pose_tracker"
    stream: Literal["wrist_left", "wrist_right", "head"]
