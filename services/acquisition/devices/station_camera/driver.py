"""Driver of a camera on the station itself, whose images are stamped, checked and encoded here.

Stamps of the driver are on this host's monotonic clock; an image carries the middle of its
exposure. A camera whose stamps are on another clock gives arrival stamps only, and says so.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from dextouch.errors import DeviceError, InvalidInputError
from dextouch.schemas import Matrix
from dextouch.streams import (
    NO_DEVICE_TIME,
    NO_SEQUENCE,
    ClockCapabilities,
    Sample,
    StreamDescriptor,
)
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import DeviceKind
from services.acquisition.devices.station_camera.capture import (
    NS_PER_MS,
    CapturedImage,
    CaptureLink,
    OpenCvCapture,
    StationCameraSettings,
    find_camera,
    nanoseconds,
)
from services.acquisition.drivers.base import Decoder, Driver, Readings
from services.acquisition.drivers.image_encoding import (
    EncodingQueue,
    ImageEncoder,
)
from services.acquisition.drivers.image_quality import ImageChecker, ImageQuality
from services.acquisition.drivers.packets import DecoderStatistics

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

    Args:
        settings: name, size, rate, encoding and timing.
        link: opens the camera.
        clock: of the station.
        max_encode_wait_s: how long a read waits for the encoder, so that an image need not wait
            for the next one; half a period if None.
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
        super().__init__(settings.stream, transport=link, decoder=self._stamps, clock=clock)
        self._link, self._settings = link, settings
        encoder = ImageEncoder(settings.encoding, settings.size_px, rate_hz=settings.rate_hz)
        self._queue = EncodingQueue(encoder, name=settings.stream)
        self._checker = ImageChecker(period_ns=settings.period_ns)
        period_s = settings.period_ns / 1e9
        self._encode_wait_s = period_s / 2 if max_encode_wait_s is None else max_encode_wait_s
        self._exposure_ns = settings.exposure_ns
        self._heard_ns: int | None = None
        self._silence_ns = FIRST_IMAGE_NS

    @property
    def quality(self) -> ImageQuality:
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
        if self._link.wait(READ_TIMEOUT_S):
            t_host_ns = self._clock.now_ns()
            self._heard_ns = t_host_ns
            self._silence_ns = max(MIN_SILENCE_NS, SILENT_PERIODS * self._settings.period_ns)
            self._take(self._link.retrieve(), t_host_ns)
        else:
            self._check_silence()
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
        stamp = self._stamps.accept(captured.t_driver_ns, t_host_ns)
        if stamp is None:
            return
        t_driver_ns, number = stamp
        has_time = t_driver_ns != NO_DEVICE_TIME
        self._checker.check(image, t_driver_ns if has_time else None)
        t_device_ns = self._middle_of_exposure_ns(t_driver_ns) if has_time else NO_DEVICE_TIME
        if not self._queue.put(Sample(t_host_ns, image, t_device_ns, number)):
            statistics.lost += 1

    def _middle_of_exposure_ns(self, t_driver_ns: int) -> int:
        half_ns = (self._exposure_ns or 0) // 2
        return (
            t_driver_ns + half_ns
            if self._settings.stamp_point == "start"
            else t_driver_ns - half_ns
        )

    def _check_silence(self) -> None:
        if self._heard_ns is None:
            return
        silent_ns = self._clock.now_ns() - self._heard_ns
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
