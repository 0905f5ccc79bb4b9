"""Reader threads of devices, with reconnection."""

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import structlog
from jaxtyping import UInt16

from dextouch.errors import DeviceError, PacketError
from dextouch.schemas import SharedLink
from dextouch.streams import Sample
from services.acquisition.clock import StationClock, Waiter
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.transports import TransportInfo

logger = structlog.get_logger(__name__)

RETRY_NS = 200_000_000
# What stays the same is logged once and then so rarely, with its count.
LOG_AGAIN_NS = 60_000_000_000
NOTHING_LOGGED = ("", 0, 0)
# What a supervisor counts besides the driver. An error of a driver says which of them it is in its
# detail `event`.
EVENTS = (
    "lost_device",
    "wrong_version",
    "wrong_side",
    "wrong_serial_number",
    "wrong_hello",
    "wrong_nodes",
    "ambiguous_device",
    "absent_device",
    "silent_bridge",
    "driver_failure",
)
SYSFS = Path("/sys/class")
# Kernel classes of the device files that transports open.
CLASSES = ("tty", "video4linux", "hidraw")
# A port of a hub in sysfs: bus, then ports from the root on, as in 1-2.4.
_USB_PORT = re.compile(r"^\d+-\d+(?:\.\d+)*$")
_LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1", "[::1]"})
Sink = Callable[[Readings], None]


@dataclass
class StreamCounters:
    """One stream's counts; written by its reader thread alone.

    `num_bytes` are those of the payloads. The least and greatest count of each raw cell, which show
    a dead or pinned one, are kept where samples are raw counts of a glove, the only unsigned 16-bit
    rows there are.
    """

    num_samples: int = 0
    num_bytes: int = 0
    first_t_host_ns: int | None = None
    last_t_host_ns: int | None = None
    largest_gap_ns: int = 0
    low_counts: UInt16[np.ndarray, " n"] | None = None
    high_counts: UInt16[np.ndarray, " n"] | None = None

    def add(self, samples: Sequence[Sample]) -> None:
        """Count new samples."""
        for sample in samples:
            values = sample.values
            if self.last_t_host_ns is None:
                self.first_t_host_ns = sample.t_host_ns
                if values.dtype == np.uint16 and values.ndim == 1:
                    self.low_counts, self.high_counts = values.copy(), values.copy()
            else:
                gap_ns = sample.t_host_ns - self.last_t_host_ns
                self.largest_gap_ns = max(self.largest_gap_ns, gap_ns)
            self.last_t_host_ns = sample.t_host_ns
            encoded = values.dtype == np.object_
            self.num_bytes += len(values.item()) if encoded else values.nbytes
            if self.low_counts is not None and self.high_counts is not None:
                np.minimum(self.low_counts, values, out=self.low_counts)
                np.maximum(self.high_counts, values, out=self.high_counts)
        self.num_samples += len(samples)


class DeviceSupervisor:
    """Reads one device while the station runs, and reopens it after every disconnection.

    The driver is used by the supervisor's thread alone, in which `sink` gets new readings.

    `reconnects` says how often it was lost after it was open, `last_error` why, or why it could not
    be opened (None while it is open), `shares` what it shared with other devices where it was
    opened last.
    """

    def __init__(self, driver: Driver, *, sink: Sink, clock: StationClock) -> None:
        self.driver = driver
        self.connected = threading.Event()
        self.reconnects = 0
        self.last_error: str | None = None
        self.streams = {d.name: StreamCounters() for d in driver.descriptors}
        self.shares = shared_link(driver.info)
        self._events = dict.fromkeys(EVENTS, 0)
        self._sink = sink
        # The last message that was logged, when, and how often it came since it was new.
        self._logged = NOTHING_LOGGED
        self._clock = clock
        self._stopping = threading.Event()
        self._waiter: Waiter | None = None
        self._waiter_lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=f"read-{driver.name}", daemon=True)

    @property
    def is_running(self) -> bool:
        """Whether the thread that reads the device, or waits for it, is there."""
        return self._thread.is_alive()

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

    def events(self) -> dict[str, int]:
        """Counts of all that happened to the device since the start, by name."""
        return {**self.driver.events(), **self._events}

    def count(self, readings: Readings) -> None:
        """Count new samples (called by the reader thread)."""
        for name, samples in readings.items():
            self.streams[name].add(samples)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._read_until_lost()
            except (DeviceError, PacketError) as error:
                self.last_error = error.message
                self._count_loss(error)
                if count := self._count_to_log(error.message):
                    about = {"device": self.driver.name, "error": error.message}
                    logger.warning("lose_device", **about, count=count)
                self._close_and_wait()
            except Exception as error:
                self._events["driver_failure"] += 1
                self.last_error = f"{type(error).__name__}: {error}"
                if count := self._count_to_log(self.last_error):
                    logger.exception("fail_device", device=self.driver.name, count=count)
                self._close_and_wait()
        self.driver.close()
        self.connected.clear()

    def _read_until_lost(self) -> None:
        self.driver.open()
        self.shares = shared_link(self.driver.info)
        self.last_error = None
        self.connected.set()
        with self._waiter_lock:
            if self._waiter is not None:
                self._waiter.close()
                self._waiter = None
        while not self._stopping.is_set():
            # A decoder may name a stream without a sample.
            readings = {name: samples for name, samples in self.driver.read().items() if samples}
            if readings:
                # A loss of a device that gave something is new, whatever it says.
                self._logged = NOTHING_LOGGED
                self.count(readings)
                self._sink(readings)

    def _count_loss(self, error: DeviceError | PacketError) -> None:
        event = error.details.get("event")
        if isinstance(event, str) and event in self._events:
            self._events[event] += 1
        elif self.connected.is_set():
            # Failing to open a device that is gone is no further loss.
            self._events["lost_device"] += 1

    def _count_to_log(self, message: str) -> int:
        """How often a problem came: a new one at once, a continuing one once a minute, else 0."""
        now_ns = self._clock.now_ns()
        last_message, logged_ns, count = self._logged
        if message == last_message and now_ns - logged_ns < LOG_AGAIN_NS:
            self._logged = (message, logged_ns, count + 1)
            return 0
        count = count + 1 if message == last_message else 1
        self._logged = (message, now_ns, count)
        return count

    def _close_and_wait(self) -> None:
        # The waiter comes before the closing and goes after the next opening, so that a virtual
        # clock stands still in between and a loss always costs the same time.
        with self._waiter_lock:
            if self._waiter is None:
                self._waiter = self._clock.waiter()
            if self._stopping.is_set():
                self._waiter.cancel()
        if self.connected.is_set():
            self.reconnects += 1
        self.connected.clear()
        self.driver.close()
        self._waiter.wait_until(self._clock.now_ns() + RETRY_NS)


def shared_link(info: TransportInfo, *, sysfs: Path = SYSFS) -> SharedLink | None:
    """The hub, remote host or local program that a transport leads through.

    None where it is plugged into this computer directly, or where nothing is known.
    """
    if info.kind == "socket":
        return _of_socket(info.address)
    hub = _usb_hub(info.address, sysfs) if info.address.startswith("/dev/") else None
    return None if hub is None else SharedLink(kind="hub", name=hub)


def _of_socket(address: str) -> SharedLink | None:
    if address.startswith("/"):
        return SharedLink(kind="bridge", name=address)
    host, separator, port = address.rpartition(":")
    if not separator or not port.isdecimal():
        return None
    if host in _LOOPBACK:
        return SharedLink(kind="bridge", name=address)
    return SharedLink(kind="network", name=host)


def _usb_hub(address: str, sysfs: Path) -> str | None:
    """Path of the hub above a device file, such as 1-2; None for a port of the root hub."""
    name = Path(address).resolve().name
    for kind in CLASSES:
        link = sysfs / kind / name / "device"
        if link.exists():
            ports = [part for part in link.resolve().parts if _USB_PORT.match(part)]
            return ports[-1].rpartition(".")[0] or None if ports else None
    return None
