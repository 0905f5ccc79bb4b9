"""A virtual host whose NTP daemon slews its clock."""

import time

import numpy as np

from services.acquisition.clock import StationClock, VirtualClock


class SlewedClock(VirtualClock):
    """All clocks but CLOCK_MONOTONIC_RAW gain `slew_ns` within 0.6 s, as chrony does it.

    Its maxslewrate is 83 333 ppm. Virtual time is what the raw clock shows; only the operating
    system's clocks are simulated, the station's clock reads them itself.
    """

    lasts_ns = 600_000_000

    def __init__(self, at_ns, slew_ns):
        self._slew = (at_ns, at_ns + self.lasts_ns), (0, slew_ns)
        super().__init__()

    def read_ns(self, clock_id):
        is_raw = clock_id == time.CLOCK_MONOTONIC_RAW
        gained_ns = 0 if is_raw else round(float(np.interp(self._now_ns, *self._slew)))
        return self._now_ns + gained_ns

    now_ns = StationClock.now_ns
    suspended_ns = StationClock.suspended_ns
    wall_offset_ns = StationClock.wall_offset_ns
