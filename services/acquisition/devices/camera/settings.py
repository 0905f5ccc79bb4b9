"""Settings of a camera bridge."""

from typing import Annotated, Literal

from pydantic import Field

from services.acquisition.devices.tcp import TcpSettings

# `camera_head` is what episodes need; any number of others may stand beside it.
CameraStream = Annotated[str, Field(pattern=r"^camera_[a-z0-9_]{1,57}$")]


class CameraSettings(TcpSettings):
    """A camera bridge at a TCP address."""

    kind: Literal["camera"] = "camera"
    stream: CameraStream
    height_px: int = Field(default=480, gt=0)
    width_px: int = Field(default=640, gt=0)
    encoding: Literal["rgb8", "jpeg", "h264"] = "jpeg"
