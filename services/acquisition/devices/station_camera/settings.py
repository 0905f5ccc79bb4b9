"""Settings of a camera on the station's own bus."""

from typing import Literal

from pydantic import Field, model_validator

from services.acquisition.devices.kind import CameraStream, DeviceSettings


class StationCameraSettings(DeviceSettings):
    """A camera on this host by V4L2, found by its serial number or, failing that, by a device.

    `exposure_ms` absent leaves the exposure to the camera. `stamp_point` is the end of the
    exposure at which its driver stamps. `fourcc` is the pixel format on the wire, such as MJPG or
    YUYV. A camera that gives another size or rate is refused. `latency_ms` is calibrated: from the
    middle of the exposure to the earliest arrival; it comes with its sigma or not at all.
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

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the images."""
        return self.height_px, self.width_px

    @property
    def period_ns(self) -> int:
        """Nominal distance of two images."""
        return round(1e9 / self.rate_hz)

    @property
    def exposure_ns(self) -> int | None:
        """Fixed exposure; None leaves it to the camera."""
        return nanoseconds(self.exposure_ms)

    @model_validator(mode="after")
    def _exposure_within_period(self) -> "StationCameraSettings":
        exposure_ns = self.exposure_ns
        if exposure_ns is not None and not 0 < exposure_ns <= 1e9 / self.rate_hz:
            raise ValueError(
                f"camera {self.stream}: got an exposure of {exposure_ns} ns, expected more than 0 "
                f"and at most the period of {self.rate_hz:g} Hz"
            )
        return self

    @model_validator(mode="after")
    def _latency_with_sigma(self) -> "StationCameraSettings":
        if (self.latency_ms is None) != (self.latency_sigma_ms is None):
            raise ValueError(
                f"camera {self.stream}: got latency {self.latency_ms} ms with sigma "
                f"{self.latency_sigma_ms} ms, expected both or neither"
            )
        return self


def nanoseconds(milliseconds: float | None) -> int | None:
    """Whole nanoseconds; None of None."""
    return None if milliseconds is None else round(milliseconds * 1e6)
