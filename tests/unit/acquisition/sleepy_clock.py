"""A virtual clock whose host can be put to sleep."""

import time

from services.acquisition.clock import VirtualClock


class SleepyClock(VirtualClock):
    """Time may pass without any thread running."""

    slept_ns = 0

    def suspend(self, duration_ns):
        with self.lock:
            self._now_ns += duration_ns
            self.slept_ns += duration_ns
            self.advance()

    def read_ns(self, clock_id):
        has_slept = clock_id in {time.CLOCK_MONOTONIC, time.CLOCK_MONOTONIC_RAW}
        return self._now_ns - has_slept * self.slept_ns

    def suspended_ns(self):
        return self.slept_ns
