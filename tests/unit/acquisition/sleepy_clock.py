"""A virtual clock whose host can be put to sleep."""

from services.acquisition.clock import VirtualClock


class SleepyClock(VirtualClock):
    """Time may pass without any thread running."""

    slept_ns = 0

    def suspend(self, duration_ns):
        with self.lock:
            self._now_ns += duration_ns
            self.slept_ns += duration_ns
            self.advance()

    def suspended_ns(self):
        return self.slept_ns
