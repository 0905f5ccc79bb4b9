"""Settings of a pose tracker."""

from typing import Literal

from pydantic import field_validator

from services.acquisition.devices.kind import StreamName
from services.acquisition.devices.tracker_links import TrackerSettings

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
