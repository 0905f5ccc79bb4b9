"""One thread per device: its driver comes in, counted readings go to a sink, whatever happens."""

import threading
from collections.abc import Callable
from contextlib import closing

import structlog

from dextouch.errors import DeviceError
from services.acquisition.clock import StationClock, Waiter
from services.acquisition.counters import DeviceCounters
from services.acquisition.drivers.base import Driver, Readings

logger = structlog.get_logger(__name__)

RETRY_NS = 200_000_000
Sink = Callable[[str, Readings], None]


class DeviceSupervisor:
    """Reads one device for as long as the station runs and opens it again after every loss.

    Args:
        driver: of the device; used by the supervisor's thread alone.
        sink: called in that thread with the device's name and its new readings.
        clock: of the station.
    """

    def __init__(self, driver: Driver, *, sink: Sink, clock: StationClock) -> None:
        self.driver = driver
        self.counters = DeviceCounters.of(driver)
        self.connected = threading.Event()
        self._sink = sink
        self._clock = clock
        self._stopping = threading.Event()
        self._waiter: Waiter | None = None
        self._waiter_lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=f"read-{driver.name}", daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread (within a read's timeout) and close the device."""
        self._stopping.set()
        with self._waiter_lock:
            if self._waiter is not None:
                self._waiter.cancel()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._read_until_lost()
            except DeviceError as error:
                self.counters.last_error = error.message
                logger.warning("lose_device", device=self.driver.name, error=error.message)
                self._close_and_wait()
            except Exception as error:
                self.counters.failures += 1
                self.counters.last_error = f"{type(error).__name__}: {error}"
                logger.exception("fail_device", device=self.driver.name)
                self._close_and_wait()
        self.driver.close()
        self._set_connected(is_connected=False)

    def _read_until_lost(self) -> None:
        self.driver.open()
        self._set_connected(is_connected=True)
        self._release_waiter()
        while not self._stopping.is_set():
            readings = self.driver.read()
            if readings:
                self.counters.add(readings)
                self._sink(self.driver.name, readings)

    def _set_connected(self, *, is_connected: bool) -> None:
        self.counters.is_connected = is_connected
        if is_connected:
            self.counters.last_error = None
            self.connected.set()
        else:
            self.connected.clear()

    def _close_and_wait(self) -> None:
        # The waiter comes before the closing and goes after the next opening, so that a virtual
        # clock stands still in between and a loss always costs the same time.
        with self._waiter_lock:
            if self._waiter is None:
                self._waiter = self._clock.waiter()
            if self._stopping.is_set():
                self._waiter.cancel()
        if self.counters.is_connected:
            self.counters.reconnects += 1
        self._set_connected(is_connected=False)
        self.driver.close()
        self._waiter.wait_until(self._clock.now_ns() + RETRY_NS)

    def _release_waiter(self) -> None:
        with self._waiter_lock:
            if self._waiter is not None:
                waiter, self._waiter = self._waiter, None
                with closing(waiter):
                    pass
