"""Driver of a camera on the station itself, whose images are stamped, checked and encoded here.

Stamps of the driver are on CLOCK_MONOTONIC and converted to the clock of the station; an image
carries the middle of its exposure. A camera whose stamps are on another clock gives arrival stamps
only, and says so.
"""

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import CLOCK_MONOTONIC
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field, model_validator

from dextouch.errors import DeviceError, InvalidInputError
from dextouch.schemas import Matrix
from dextouch.streams import (
    NO_DEVICE_TIME,
    NO_SEQUENCE,
    ClockCapabilities,
    Sample,
    StreamDescriptor,
)
from services.acquisition.clock import StationClock, station_offset_ns
from services.acquisition.devices.kinds import CameraStream, DeviceKind, DeviceSettings
from services.acquisition.drivers import images
from services.acquisition.drivers.base import Decoder, Driver, Readings
from services.acquisition.drivers.packets import DecoderStatistics
from services.acquisition.transports import Handle, HandleTransport, TransportInfo

if TYPE_CHECKING:
    import cv2

BY_ID = Path("/dev/v4l/by-id")
NS_PER_MS = 1_000_000
# V4L2 counts exposure in steps of 100 µs; 1 is its manual mode, 3 that of automatic exposure.
EXPOSURE_UNIT_NS = 100_000
MANUAL_EXPOSURE, AUTOMATIC_EXPOSURE = 1, 3
RATE_TOLERANCE = 0.02
READ_TIMEOUT_S = 0.05
# A camera that says nothing for so long is lost; the first image may take longer.
MIN_SILENCE_NS = 250_000_000
SILENT_PERIODS = 5
FIRST_IMAGE_NS = 3_000_000_000
# The kernel stamps in microseconds.
STAMP_TICK_NS = 1_000
# How old the first image's stamp may be to be one of this host's clock; later ones may have waited.
MAX_FIRST_AGE_NS = 1_000_000_000
MAX_AGE_NS = 10_000_000_000
MAX_AHEAD_NS = 100_000
MAX_BAD_STAMPS = 10


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

    `exposure_ns` is what the opened camera states; None where it does not.
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

    `find` gives the device, such as /dev/video0, at every opening.
    """

    def __init__(self, find: Callable[[], str], request: StationCameraSettings) -> None:
        address = request.serial_number or request.device or "not opened"
        super().__init__(address=address, serial_number=request.serial_number)
        self._find = find
        self._request = request

    def wait(self, timeout_s: float) -> bool:
        """See `CaptureLink`."""
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
        """See `CaptureLink`."""
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
    """The device of the camera with this serial number, by the kernel's links in `folder`.

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


class DriverStamps(Decoder):
    """The decoder's part of a camera that gives images and no bytes: judges its driver's stamps.

    Gives each image its device time and number, or refuses it and counts that. The number counts
    the images that must have been there, by the stamps: what got lost before us leaves a gap in it.
    """

    def __init__(self, settings: StationCameraSettings) -> None:
        self.statistics = DecoderStatistics()
        # Without device time once the driver's stamps proved useless.
        self.descriptors = (
            StreamDescriptor(
                name=settings.stream,
                kind="image",
                shape=(*settings.size_px, 3),
                dtype="uint8",
                unit=settings.encoding,
                nominal_rate_hz=settings.rate_hz,
                frame=settings.stream,
                device=settings.stream,
                capabilities=ClockCapabilities(device_time=True, tick_ns=STAMP_TICK_NS),
            ),
        )
        self.usable: bool | None = None
        self._settings = settings
        self._last_ns: int | None = None
        self._number = 0
        self._num_bad = 0

    def reset(self) -> None:
        """There is no half image."""

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Refused."""
        raise DeviceError(
            f"{self._settings.stream}: got {len(data)} bytes at {t_host_ns}, no image"
        )

    def accept(self, t_driver_ns: int | None, t_host_ns: int) -> tuple[int, int] | None:
        """Stamp and number of an image; without a usable clock the values for "none".

        Both times are on CLOCK_MONOTONIC.

        Returns:
            None if the image must be dropped: repeated, or with a stamp that cannot be.

        Raises:
            DeviceError: the stamps have left the host's clock; they are not used any more.
        """
        if self.usable is None:
            self.usable = True
            if not _is_plausible(t_driver_ns, t_host_ns, MAX_FIRST_AGE_NS):
                self._give_up()
        if not self.usable:
            return NO_DEVICE_TIME, NO_SEQUENCE
        if t_driver_ns is None or not _is_plausible(t_driver_ns, t_host_ns, MAX_AGE_NS):
            self._refuse()
            return None
        if self._last_ns is not None and t_driver_ns <= self._last_ns:
            if t_driver_ns == self._last_ns:
                self.statistics.repeated += 1
            else:
                self._refuse()
            return None
        self._num_bad = 0
        if self._last_ns is not None:
            steps = max(1, round((t_driver_ns - self._last_ns) / self._settings.period_ns))
            self.statistics.lost += steps - 1
            self._number += steps
        self._last_ns = t_driver_ns
        return t_driver_ns, self._number

    def _give_up(self) -> None:
        self.usable = False
        (descriptor,) = self.descriptors
        without = {"capabilities": ClockCapabilities()}
        self.descriptors = (descriptor.model_copy(update=without),)

    def _refuse(self) -> None:
        self.statistics.refused += 1
        self._num_bad += 1
        if self._num_bad >= MAX_BAD_STAMPS:
            self._give_up()
            raise DeviceError(
                f"{self._settings.stream}: {self._num_bad} timestamps in a row are "
                "not on this host's clock, unlike the first ones; from now on its images have "
                "arrival timestamps only",
                device=self._settings.stream,
            )


class StationCamera(Driver):
    """A camera on this host; encodes in a separate thread.

    `t_host_ns` of a sample is when its image was fetched, `t_device_ns` the middle of its exposure
    by the driver's stamp, on the same clock.

    A read waits `max_encode_wait_s` for the encoder, half a period if None, so that an image need
    not wait for the next one.
    """

    def __init__(
        self,
        settings: StationCameraSettings,
        *,
        link: CaptureLink[Any],
        clock: StationClock,
        max_encode_wait_s: float | None = None,
    ) -> None:
        self._stamps = DriverStamps(settings)
        # CLOCK_MONOTONIC and what it needs to be on the station's clock, but for the time in
        # suspend, at the last image but one and at the last.
        self._clock_pairs: deque[tuple[int, int]] = deque(maxlen=2)
        super().__init__(settings.stream, transport=link, decoder=self._stamps, clock=clock)
        self._link, self._settings = link, settings
        encoder = images.ImageEncoder(settings.encoding, settings.size_px, rate_hz=settings.rate_hz)
        self._queue = images.EncodingQueue(encoder, name=settings.stream)
        self._checker = images.ImageChecker(period_ns=settings.period_ns)
        period_s = settings.period_ns / 1e9
        self._encode_wait_s = period_s / 2 if max_encode_wait_s is None else max_encode_wait_s
        self._exposure_ns = settings.exposure_ns
        self._heard_ns: int | None = None
        self._silence_ns = FIRST_IMAGE_NS

    @property
    def quality(self) -> images.ImageQuality:
        """What the images are like."""
        return replace(self._checker.quality, num_dropped=self._queue.num_dropped)

    def calibration(self) -> dict[str, Matrix]:
        """Latency with its sigma, if calibrated, and the exposure that the stamps assume."""
        record = {
            "latency_ns": nanoseconds(self._settings.latency_ms),
            "latency_sigma_ns": nanoseconds(self._settings.latency_sigma_ms),
            "exposure_ns": self._exposure_ns,
        }
        return {
            f"{self.name}_{name}": ((float(value),),)
            for name, value in record.items()
            if value is not None
        }

    def begin_take(self) -> Mapping[str, Matrix]:
        """The next image begins a group of pictures; called from any thread."""
        self._queue.begin_group()
        return self.calibration()

    def open(self) -> None:
        """Open the camera.

        Raises:
            DeviceError: it is absent, in use, or cannot do what it is asked for.
        """
        super().open()
        exposure_ns = self._link.exposure_ns
        self._exposure_ns = self._settings.exposure_ns if exposure_ns is None else exposure_ns
        self._heard_ns, self._silence_ns = self._clock.now_ns(), FIRST_IMAGE_NS

    def read(self) -> Readings:
        """New samples, each image once; empty when none came.

        Raises:
            DeviceError: the camera is gone, silent, or gives other images than asked for.
        """
        asked_ns = self._clock.now_ns()
        if self._link.wait(READ_TIMEOUT_S):
            t_host_ns = self._clock.now_ns()
            monotonic_ns = self._clock.read_ns(CLOCK_MONOTONIC)
            offset_ns = station_offset_ns(self._clock) - self._clock.suspended_ns()
            self._clock_pairs.append((monotonic_ns, offset_ns))
            self._heard_ns = t_host_ns
            self._silence_ns = max(MIN_SILENCE_NS, SILENT_PERIODS * self._settings.period_ns)
            self._take(self._link.retrieve(), t_host_ns)
        else:
            # A busy host may hold this thread up after its wait, while images come.
            waited_ns = asked_ns + round(READ_TIMEOUT_S * 1e9)
            self._check_silence(min(waited_ns, self._clock.now_ns()))
        samples = self._queue.collect(self._encode_wait_s)
        return {self.name: samples} if samples else {}

    def close(self) -> None:
        """Close the camera; images being encoded are returned by the first read after reopening."""
        super().close()
        self._queue.stop()

    def _take(self, captured: CapturedImage | None, t_host_ns: int) -> None:
        statistics = self.statistics
        if captured is None:
            statistics.refused += 1
            return
        image, expected = captured.image, (*self._settings.size_px, 3)
        if image.shape != expected:
            raise DeviceError(
                f"{self.name}: sends images {image.shape}, expected {expected}; plug it in again"
            )
        statistics.packets += 1
        stamp = self._stamps.accept(captured.t_driver_ns, self._clock_pairs[-1][0])
        if stamp is None:
            return
        t_driver_ns, number = stamp
        has_time = t_driver_ns != NO_DEVICE_TIME
        self._checker.check(image, t_driver_ns if has_time else None)
        t_device_ns = NO_DEVICE_TIME
        if has_time:
            half_ns = (self._exposure_ns or 0) // 2
            to_middle_ns = half_ns if self._settings.stamp_point == "start" else -half_ns
            t_device_ns = self._on_station_clock(t_driver_ns) + to_middle_ns
        if not self._queue.put(Sample(t_host_ns, image, t_device_ns, number)):
            statistics.lost += 1

    def _on_station_clock(self, t_driver_ns: int) -> int:
        """A stamp on CLOCK_MONOTONIC, whose rate NTP changes, on the station's clock."""
        # A stamp lies between the readings at its image and at the one before.
        since_ns = [monotonic_ns - t_driver_ns for monotonic_ns, _ in self._clock_pairs]
        ahead_ns = [offset_ns for _, offset_ns in self._clock_pairs]
        rest_ns = np.interp(0, since_ns, [ahead - ahead_ns[-1] for ahead in ahead_ns])
        return t_driver_ns + ahead_ns[-1] + round(float(rest_ns)) + self._clock.suspended_ns()

    def _check_silence(self, now_ns: int) -> None:
        if self._heard_ns is None:
            return
        silent_ns = now_ns - self._heard_ns
        if silent_ns > self._silence_ns:
            raise DeviceError(
                f"{self.name}: no image for {silent_ns / NS_PER_MS:.0f} ms from {self.info}, "
                f"expected one every {self._settings.period_ns / NS_PER_MS:.0f} ms",
                device=self.name,
            )


def _is_plausible(t_driver_ns: int | None, t_host_ns: int, max_age_ns: int) -> bool:
    if t_driver_ns is None:
        return False
    return -MAX_AHEAD_NS <= t_host_ns - t_driver_ns <= max_age_ns


def build(settings: StationCameraSettings, clock: StationClock) -> StationCamera:
    """The driver of one camera.

    Raises:
        InvalidInputError: neither serial number nor device.
    """
    find: Callable[[], str]
    if settings.serial_number is not None:
        find = partial(find_camera, settings.serial_number)
    elif settings.device is not None:
        find = partial(str, settings.device)
    else:
        raise InvalidInputError(f"camera {settings.stream}: set its serial_number or its device")
    return StationCamera(settings, link=OpenCvCapture(find, settings), clock=clock)


KIND = DeviceKind(name="station_camera", settings=StationCameraSettings, build=build)
