"""Settings of a camera bridge."""

from typing import Literal

from pydantic import Field

from services.acquisition.devices.tcp import TcpSettings

CameraStream = Literal["camera_head", "camera_wrist_left", "camera_wrist_right"]


class CameraSettings(TcpSettings):
    """A camera bridge at a TCP address."""

    kind: Literal["camera"] = "camera"
    stream: CameraStream
    height_px: int = Field(default=480, gt=0)
    width_px: int = Field(default=640, gt=0)
    encoding: Literal["rgb8", "jpeg", "h264"] = "jpeg"
