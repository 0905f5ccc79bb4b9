"""Judgement of the stamps of a camera's kernel driver: which are times, which images are new."""

from dextouch.errors import DeviceError
from dextouch.streams import NO_DEVICE_TIME, NO_SEQUENCE
from services.acquisition.drivers.packet_search import DecoderStatistics

# How old the first image's stamp may be to be one of this host's clock; later ones may have waited.
MAX_FIRST_AGE_NS = 1_000_000_000
MAX_AGE_NS = 10_000_000_000
MAX_AHEAD_NS = 100_000
MAX_BAD_STAMPS = 10


class DriverStamps:
    """Gives each image its device time and number, or refuses it and counts that.

    The number counts the images that must have been there, by the stamps: what got lost before
    us leaves a gap in it.

    Args:
        camera: for messages.
        period_ns: nominal distance of two images.
        statistics: where repeated, refused and lost images are counted.
    """

    def __init__(self, camera: str, *, period_ns: int, statistics: DecoderStatistics) -> None:
        self.usable: bool | None = None
        self.least_delay_ns: int | None = None
        self._camera, self._period_ns, self._statistics = camera, period_ns, statistics
        self._last_ns: int | None = None
        self._number = 0
        self._num_bad = 0

    def accept(self, t_driver_ns: int | None, t_host_ns: int) -> tuple[int, int] | None:
        """Stamp and number of an image; without a usable clock the values for "none".

        Returns:
            None if the image must be dropped: repeated, or with a stamp that cannot be.

        Raises:
            DeviceError: the stamps have left the host's clock; they are not used any more.
        """
        if self.usable is None:
            self.usable = _is_plausible(t_driver_ns, t_host_ns, MAX_FIRST_AGE_NS)
        if not self.usable:
            return NO_DEVICE_TIME, NO_SEQUENCE
        if t_driver_ns is None or not _is_plausible(t_driver_ns, t_host_ns, MAX_AGE_NS):
            self._refuse()
            return None
        if self._last_ns is not None and t_driver_ns == self._last_ns:
            self._statistics.repeated += 1
            return None
        if self._last_ns is not None and t_driver_ns < self._last_ns:
            self._refuse()
            return None
        self._num_bad = 0
        if self._last_ns is not None:
            steps = max(1, round((t_driver_ns - self._last_ns) / self._period_ns))
            self._statistics.lost += steps - 1
            self._number += steps
        self._last_ns = t_driver_ns
        delay_ns = t_host_ns - t_driver_ns
        if self.least_delay_ns is None or delay_ns < self.least_delay_ns:
            self.least_delay_ns = delay_ns
        return t_driver_ns, self._number

    def _refuse(self) -> None:
        self._statistics.refused += 1
        self._num_bad += 1
        if self._num_bad >= MAX_BAD_STAMPS:
            self.usable = False
            raise DeviceError(
                f"{self._camera}: {self._num_bad} timestamps in a row are "
                "not on this host's clock, unlike the first ones; from now on its images have "
                "arrival timestamps only",
                device=self._camera,
            )


def _is_plausible(t_driver_ns: int | None, t_host_ns: int, max_age_ns: int) -> bool:
    if t_driver_ns is None:
        return False
    return -MAX_AHEAD_NS <= t_host_ns - t_driver_ns <= max_age_ns
