"""Settings of a camera on the station's own bus."""

from typing import Literal

from pydantic import Field, model_validator

from services.acquisition.devices.camera.settings import CameraStream
from services.acquisition.devices.kind import DeviceSettings


class StationCameraSettings(DeviceSettings):
    """A camera on this host by V4L2, found by its serial number or, failing that, by a device.

    `exposure_ms` absent leaves the exposure to the camera. `stamp_point` is the end of the
    exposure at which its driver stamps. `latency_ms` is calibrated: from the middle of the
    exposure to the earliest arrival; it comes with its sigma or not at all.
    """

    kind: Literal["station_camera"] = "station_camera"
    stream: CameraStream
    serial_number: str | None = None
    device: str | None = None
    fourcc: str = Field(default="MJPG", min_length=4, max_length=4)
    height_px: int = Field(default=480, gt=0)
    width_px: int = Field(default=640, gt=0)
    rate_hz: float = Field(default=30.0, gt=0, le=1000)
    exposure_ms: float | None = Field(default=None, gt=0, le=1000)
    stamp_point: Literal["start", "end"] = "start"
    latency_ms: float | None = Field(default=None, ge=0, le=1000)
    latency_sigma_ms: float | None = Field(default=None, gt=0, le=1000)
    encoding: Literal["rgb8", "jpeg", "h264"] = "jpeg"

    @model_validator(mode="after")
    def _latency_with_sigma(self) -> "StationCameraSettings":
        if (self.latency_ms is None) != (self.latency_sigma_ms is None):
            raise ValueError(
                f"camera {self.stream}: got latency {self.latency_ms} ms with sigma "
                f"{self.latency_sigma_ms} ms, expected both or neither"
            )
        return self
