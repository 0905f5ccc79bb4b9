"""Settings of a camera on the station's own bus."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field, model_validator

from dextouch.errors import DeviceError
from services.acquisition.devices.kinds import CameraStream, DeviceSettings
from services.acquisition.transports.ports import Handle, HandleTransport, TransportInfo

if TYPE_CHECKING:
    import cv2

BY_ID = Path("/dev/v4l/by-id")
NS_PER_MS = 1_000_000
# V4L2 counts exposure in steps of 100 µs; 1 is its manual mode, 3 that of automatic exposure.
EXPOSURE_UNIT_NS = 100_000
MANUAL_EXPOSURE, AUTOMATIC_EXPOSURE = 1, 3
RATE_TOLERANCE = 0.02


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
    def _timing_is_possible(self) -> "StationCameraSettings":
        exposure_ns = self.exposure_ns
        if exposure_ns is not None and not 0 < exposure_ns <= 1e9 / self.rate_hz:
            raise ValueError(
                f"camera {self.stream}: got an exposure of {exposure_ns} ns, expected more than 0 "
                f"and at most the period of {self.rate_hz:g} Hz"
            )
        if (self.latency_ms is None) != (self.latency_sigma_ms is None):
            raise ValueError(
                f"camera {self.stream}: got latency {self.latency_ms} ms with sigma "
                f"{self.latency_sigma_ms} ms, expected both or neither"
            )
        return self


def nanoseconds(milliseconds: float | None) -> int | None:
    """Whole nanoseconds; None of None."""
    return None if milliseconds is None else round(milliseconds * 1e6)


@dataclass(frozen=True)
class CapturedImage:
    """An image, RGB, and what the driver says about when it was taken (None: nothing)."""

    image: UInt8[np.ndarray, "h w 3"]
    t_driver_ns: int | None


class CaptureLink(HandleTransport[Handle]):
    """Base of transports to a camera, which gives images instead of bytes.

    Args:
        address: for messages.
        serial_number: of the camera, for messages.

    Attributes:
        exposure_ns: what the opened camera states; None where it does not.
    """

    advice = "is it plugged in, is it in use, may this user read it?"

    def __init__(self, *, address: str, serial_number: str | None = None) -> None:
        super().__init__(TransportInfo("camera", address, serial_number))
        self.exposure_ns: int | None = None

    @abstractmethod
    def wait(self, timeout_s: float) -> bool:
        """Fetch the next image; False when none came in time.

        Raises:
            DeviceError: the camera is gone, or not open.
        """

    @abstractmethod
    def retrieve(self) -> CapturedImage | None:
        """Decode the image fetched by `wait`; None when it is damaged."""

    def _receive(self, handle: Handle) -> bytes:
        raise DeviceError(f"{self.info}: provides images, not bytes; read it by `wait`")

    def _send(self, handle: Handle, data: bytes) -> None:
        raise DeviceError(f"{self.info}: accepts no data, got {len(data)}")


class OpenCvCapture(CaptureLink["cv2.VideoCapture"]):
    """A camera by OpenCV's V4L2 backend.

    Args:
        find: gives the device, such as /dev/video0, at every opening.
        request: size, rate, pixel format and exposure that it must give.
    """

    def __init__(self, find: Callable[[], str], request: StationCameraSettings) -> None:
        address = request.serial_number or request.device or "not opened"
        super().__init__(address=address, serial_number=request.serial_number)
        self._find = find
        self._request = request

    def wait(self, timeout_s: float) -> bool:
        """Fetch the next image; False when none came in time.

        Raises:
            DeviceError: the camera is gone, or not open.
        """
        import cv2

        timeout_ns = max(1, round(timeout_s * 1e9))
        try:
            came, ready = cv2.VideoCapture.waitAny([self._opened()], timeoutNs=timeout_ns)
        except cv2.error as error:
            raise DeviceError(f"{self.info}: unplugged while reading") from error
        if came and not len(ready):
            # Neither an image nor the end of the timeout: hung up.
            raise DeviceError(f"{self.info}: unplugged while waiting")
        return bool(came)

    def retrieve(self) -> CapturedImage | None:
        """Decode the image fetched by `wait`; None when it is damaged."""
        import cv2

        video = self._opened()
        stamp_ms = video.get(cv2.CAP_PROP_POS_MSEC)
        try:
            is_whole, image = video.retrieve()
        except cv2.error:
            return None
        if not is_whole or image is None or image.ndim != 3:
            return None
        t_driver_ns = round(stamp_ms * NS_PER_MS) if stamp_ms > 0 else None
        return CapturedImage(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), t_driver_ns)

    def _connect(self) -> "cv2.VideoCapture":
        import cv2

        # The device of now, for messages.
        self.info = replace(self.info, address=self._find())
        try:
            video = cv2.VideoCapture(self.info.address, cv2.CAP_V4L2)
        except cv2.error as error:
            raise OSError(error) from error
        if not video.isOpened():
            raise OSError("not opened by OpenCV")
        try:
            self._ask(video)
            self._set_exposure(video)
            self._check(video)
        except DeviceError:
            video.release()
            raise
        return video

    def _release(self, handle: "cv2.VideoCapture") -> None:
        handle.release()

    def _ask(self, video: "cv2.VideoCapture") -> None:
        import cv2

        request = self._request
        # The pixel format comes first: it decides which sizes and rates there are.
        fourcc = cv2.VideoWriter.fourcc(*request.fourcc)
        video.set(cv2.CAP_PROP_FOURCC, fourcc)
        video.set(cv2.CAP_PROP_FRAME_WIDTH, request.width_px)
        video.set(cv2.CAP_PROP_FRAME_HEIGHT, request.height_px)
        video.set(cv2.CAP_PROP_FPS, request.rate_hz)
        if int(video.get(cv2.CAP_PROP_FOURCC)) != fourcc:
            raise DeviceError(f"{self.info}: has no pixel format {request.fourcc!r}")

    def _set_exposure(self, video: "cv2.VideoCapture") -> None:
        import cv2

        exposure_ns = self._request.exposure_ns
        if exposure_ns is None:
            # Cameras without the control refuse it; they are automatic anyway.
            video.set(cv2.CAP_PROP_AUTO_EXPOSURE, AUTOMATIC_EXPOSURE)
        else:
            units = max(1, round(exposure_ns / EXPOSURE_UNIT_NS))
            is_set = video.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE)
            if not is_set or not video.set(cv2.CAP_PROP_EXPOSURE, units):
                raise DeviceError(f"{self.info}: has no fixed exposure; leave it out")
        # Of automatic exposure this is where it begins, and all that is known.
        units = round(video.get(cv2.CAP_PROP_EXPOSURE))
        self.exposure_ns = units * EXPOSURE_UNIT_NS if units > 0 else None

    def _check(self, video: "cv2.VideoCapture") -> None:
        import cv2

        request = self._request
        got = (int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(video.get(cv2.CAP_PROP_FRAME_WIDTH)))
        if got != request.size_px:
            raise DeviceError(
                f"{self.info}: gives {got[1]} by {got[0]} px, expected "
                f"{request.width_px} by {request.height_px}; choose a supported size"
            )
        rate_hz = video.get(cv2.CAP_PROP_FPS)
        # Cameras that do not tell their rate say 0.
        if rate_hz > 0 and abs(rate_hz / request.rate_hz - 1) > RATE_TOLERANCE:
            raise DeviceError(
                f"{self.info}: gives {rate_hz:g} images a second, expected "
                f"{request.rate_hz:g}; choose a supported rate"
            )


def find_camera(serial_number: str, folder: Path = BY_ID) -> str:
    """The device of the camera with this serial number, whatever its name is today.

    Args:
        serial_number: as the kernel has it in the names of `folder`.
        folder: where the kernel's links are.

    Raises:
        DeviceError: no such camera is plugged in, or two are; the message lists those that are.
    """
    present = sorted(folder.glob("*-video-index0")) if folder.is_dir() else []
    found = [path for path in present if path.name.endswith(f"_{serial_number}-video-index0")]
    if len(found) != 1:
        names = ", ".join(path.name.removesuffix("-video-index0") for path in present) or "none"
        what = "is there twice" if found else "is not plugged in"
        raise DeviceError(
            f"camera with serial number {serial_number!r} {what}; present: {names}",
            serial_number=serial_number,
        )
    return str(found[0].resolve())
