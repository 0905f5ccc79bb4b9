"""A bridge: the interface to the SDK that it reads, and the server that sends on its readings.

Nothing waits for a station: each connection has a queue that drops its oldest packets when it is
full, and a thread that empties it.
"""

import contextlib
import ctypes
import json
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float
from pydantic import ValidationError

from dextouch.errors import DeviceError, InvalidInputError, UnavailableError
from dextouch.geometry.rotations import rotation_from_quaternion
from dextouch.schemas import first_problems
from dextouch.tactile.layout import Side
from services.acquisition.clock import PeriodicCall, StationClock
from services.acquisition.devices import finger_tracker, numbers, pose_tracker
from services.acquisition.drivers.packets import (
    MAX_STAMP_NS,
    SOURCES,
    VERSION,
    Packet,
    encode_packet,
)
from services.acquisition.drivers.sdk_link import (
    MAX_SOFTWARE,
    PROTOCOL,
    PROTOCOL_VERSION,
    RESTART_NS,
    BridgedDevice,
    BridgeHello,
    FrameConvention,
)

# Result and argument types of a shared library's functions, by their names.
Functions = Mapping[str, tuple[object, tuple[object, ...]]]
# Sources whose axes are ours already: right-handed, z up.
OUR_AXES = FrameConvention(handedness="right", axes=("+x", "+y", "+z"))
# OpenVR and OpenXR: right-handed, +x right, +y up, −z forward.
Y_UP_AXES = FrameConvention(handedness="right", axes=("+x", "+z", "-y"))
MAGICS = {
    "finger_tracker": finger_tracker.MAGIC,
    "pose_tracker": pose_tracker.POSE_MAGIC,
    "numbers": numbers.MAGIC,
}
# The station takes 200 ms of silence for a loss, and expects a sign of life every 50 ms.
LIFE_PERIOD_NS = 40_000_000
# Chosen: 0.5 s of one device at 1 kHz. What waits for longer than 0.2 s stations drop anyway.
QUEUE_PACKETS = 512
# Chosen: as many packets as a queue holds; the kernel would keep megabytes that become old.
SEND_BYTES = 65536
# Chosen: a station that takes nothing for so long hangs, and connects again when it does not.
SEND_TIMEOUT_S = 2.0
# Chosen: several stations and a test or two; each costs a thread.
MAX_STATIONS = 8
# Chosen: a tracker that is switched on again is back soon, and the SDK is not flooded.
RETRY_S = 2.0
# Chosen: files that were open are closed soon, and waiting costs nothing.
ACCEPT_RETRY_S = 0.1

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of one device, as the payload of its packet.

    Attributes:
        device: who read it; the name tells the clocks of several devices apart.
        place: its place by its number in packets.
        t_device_ns: when it was taken, on the source's clock.
        payload: of the packet.
    """

    device: str
    place: int
    t_device_ns: int
    payload: bytes


class Source(ABC):
    """One SDK: opened, read, and opened again after it was lost.

    Attributes:
        clock: which clock stamps its readings, and how exactly, as one line for people.
        has_station_time: whether the stamps are on the clock of a station on this host.
        not_sent: how many readings became no packet, by the reason.
    """

    clock: str
    has_station_time = True

    def __init__(self) -> None:
        self.not_sent: Counter[str] = Counter()
        self._clock = StationClock()

    @abstractmethod
    def open(self) -> BridgeHello:
        """Connect to the SDK and say which devices there are.

        Raises:
            DeviceError: it does not run, or a device is not there; worth another try.
            UnavailableError: its library is not installed.
        """

    @abstractmethod
    def read(self) -> Sequence[Reading]:
        """New readings; waits for at most some hundredths of a second.

        Raises:
            DeviceError: the SDK is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Disconnect; nothing if it is not open."""

    def present(self) -> list[str]:
        """What could be served, for people; nothing where the SDK has no names to choose from."""
        return []

    def report(self) -> list[str]:
        """Further lines for the summary."""
        return []


def import_sdk(module: str, *, install: str) -> ModuleType:
    """The Python module of an SDK; `install` says what to do where it is missing.

    Raises:
        UnavailableError: it, or the shared library that it needs, is not installed.
    """
    try:
        return import_module(module)
    except (ImportError, OSError, RuntimeError) as error:
        raise UnavailableError(
            f"the Python module {module!r} cannot be imported ({error}); {install}"
        ) from error


def structure(name: str, **fields: object) -> type[ctypes.Structure]:
    """The C structure of these fields, in their order."""
    return type(name, (ctypes.Structure,), {"_fields_": tuple(fields.items())})


def load_library(path: str, functions: Functions, *, install: str) -> ctypes.CDLL:
    """A shared library, by name or path, with the types of the used functions set.

    Raises:
        UnavailableError: it is not there, or lacks a function.
    """
    try:
        library = ctypes.CDLL(path)
        for name, (result, arguments) in functions.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise UnavailableError(f"cannot load {path!r} ({error}); {install}") from error
    return library


def hello(**about: object) -> BridgeHello:
    """The first line of the connections of a bridge: `BridgeHello` without the protocol.

    A name of the software that is too long is cut.

    Raises:
        InvalidInputError: something else is outside of its limits, such as a device's name.
    """
    about["software"] = str(about["software"])[:MAX_SOFTWARE]
    fixed = {"protocol": PROTOCOL, "version": PROTOCOL_VERSION, "length_unit": "m"}
    try:
        return BridgeHello.model_validate({**fixed, **about})
    except ValidationError as error:
        raise InvalidInputError(f"bridge: {first_problems(error)}") from error


def placed_devices(places: Mapping[str, str]) -> dict[str, BridgedDevice]:
    """Devices by their serial numbers, from where each sits.

    Raises:
        InvalidInputError: a serial number or a place that is none.
    """
    try:
        return {
            serial: BridgedDevice.model_validate(
                {"index": index, "serial_number": serial, "source": place}
            )
            for index, (serial, place) in enumerate(places.items())
        }
    except ValidationError as error:
        raise InvalidInputError(f"--device: {first_problems(error)}") from error


def pose_reading(
    device: BridgedDevice,
    t_device_ns: int,
    numbers: Sequence[float],
    *,
    result: int = pose_tracker.TrackingResult.RUNNING_OK,
    is_valid: bool = True,
) -> Reading:
    """A reading of a pose tracker.

    Args:
        device: of the hello.
        t_device_ns: when the pose was taken.
        numbers: the twelve of [R | t], row by row, in the axes and unit of the hello.
        result: of the tracking, in OpenVR's numbers; only RUNNING_OK is used by stations.
        is_valid: what the SDK says of the pose.
    """
    payload = pose_tracker.POSE_PAYLOAD.pack(
        device.index, is_valid, result, t_device_ns / 1e9, *numbers
    )
    return Reading(device.serial_number, SOURCES[device.source], t_device_ns, payload)


def hand_reading(
    device: BridgedDevice,
    t_device_ns: int,
    points: Float[np.ndarray, "25 3"],
    is_tracked: Bool[np.ndarray, "25"],
) -> Reading:
    """A reading of a finger tracker.

    Args:
        device: of the hello.
        t_device_ns: when the hand was seen.
        points: nodes in the order of the hello, relative to the wrist node and in its axes.
        is_tracked: which of them are measured; all others become NaN in a recording.
    """
    bits = sum(1 << int(node) for node in np.flatnonzero(is_tracked))
    payload = finger_tracker.VALIDITY.pack(bits) + points.astype("<f4").tobytes()
    return Reading(device.serial_number, SOURCES[device.source], t_device_ns, payload)


def wrist_axes(
    points: Float[np.ndarray, "n 3"],
    wrist: Float[np.ndarray, "3"],
    q_wxyz: Float[np.ndarray, "4"],
) -> Float[np.ndarray, "n 3"]:
    """Points relative to the wrist, in its axes: R⁻¹ (p − wrist), with R the wrist's rotation."""
    R = rotation_from_quaternion(np.asarray(q_wxyz, dtype=np.float64))
    return (np.asarray(points, dtype=np.float64) - wrist) @ R


def hand_device(index: int, side: Side, sdk: str) -> BridgedDevice:
    """The device of one hand."""
    return BridgedDevice(index=index, serial_number=f"{sdk}-{side}", source=side)


class Pace:
    """Waits for the next of evenly spaced moments, and leaves out those that have passed."""

    def __init__(self, rate_hz: float, clock: StationClock) -> None:
        self._period_ns = round(1e9 / rate_hz)
        self._clock = clock
        self._due_ns = clock.now_ns()

    def wait(self) -> None:
        """Sleep until the next moment."""
        now_ns = self._clock.now_ns()
        missed = max(0, (now_ns - self._due_ns) // self._period_ns)
        self._due_ns += (missed + 1) * self._period_ns
        time.sleep((self._due_ns - now_ns) / 1e9)


@dataclass
class Summary:
    """What a bridge did.

    Attributes:
        seconds: from its start to its end.
        sent: readings of each device, also of those that had none.
        restarts: how often the clock of each device went back by more than a second.
        old: readings whose stamps did not advance, by device; they were not sent.
        dropped: packets that a full queue lost, all stations together.
        not_sent: readings that the source left out, by the reason.
        delay_ms: smallest and mean time from stamp to sending; None where the stamps are on another
            clock.
    """

    seconds: float = 0.0
    sent: Counter[str] = field(default_factory=Counter)
    restarts: Counter[str] = field(default_factory=Counter)
    old: Counter[str] = field(default_factory=Counter)
    dropped: int = 0
    not_sent: dict[str, int] = field(default_factory=dict)
    delay_ms: tuple[float, float] | None = None

    def lines(self) -> list[str]:
        """The summary as lines for people."""
        lines = [
            f"{device}: {count} samples sent, {count / max(self.seconds, 1e-9):.1f} Hz"
            f"; {self.old[device]} old, {self.restarts[device]} restarts of the clock"
            for device, count in sorted(self.sent.items())
        ] or ["no samples"]
        lines += [f"not sent: {count} {reason}" for reason, count in sorted(self.not_sent.items())]
        if self.dropped:
            lines.append(f"lost: {self.dropped} packets, because a station did not read in time")
        if self.delay_ms is not None:
            lines.append(
                "from stamp to sending: {:.2f} ms at least, {:.2f} ms on average".format(
                    *self.delay_ms
                )
            )
        return lines

    def as_json(self) -> dict[str, object]:
        """The summary for `--json`."""
        counts = {name: dict(getattr(self, name)) for name in ("sent", "restarts", "old")}
        return {**vars(self), **counts}


class StationLink:
    """One station: a queue of packets and the thread that sends them."""

    def __init__(self, link: socket.socket, hello: bytes) -> None:
        self._link, self._hello = link, hello
        self._packets: deque[bytes] = deque(maxlen=QUEUE_PACKETS)
        self._has_some = threading.Event()
        self.is_open = True
        link.settimeout(SEND_TIMEOUT_S)
        threading.Thread(target=self._run, name="bridge-station", daemon=True).start()

    def put(self, packet: bytes) -> bool:
        """Queue a packet; whether an older one had to go for it."""
        is_full = len(self._packets) == QUEUE_PACKETS
        self._packets.append(packet)
        self._has_some.set()
        return is_full

    def close(self) -> None:
        """End the connection."""
        self.is_open = False
        self._has_some.set()
        with contextlib.suppress(OSError):  # it may be gone
            self._link.shutdown(socket.SHUT_RDWR)

    def _run(self) -> None:
        with contextlib.suppress(OSError), self._link:  # the station is gone, or hangs
            self._link.sendall(self._hello)
            while self.is_open:
                self._has_some.wait()
                self._has_some.clear()
                waiting = []
                with contextlib.suppress(IndexError):  # until it is empty
                    while True:
                        waiting.append(self._packets.popleft())
                self._link.sendall(b"".join(waiting))
        self.is_open = False


def _clear_path(path: Path) -> None:
    """Remove the socket that a killed bridge has left behind, and refuse that of a running one."""
    if not path.is_socket():
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        try:
            link.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
    raise InvalidInputError(f"{path}: another bridge listens here; choose another --path")


class BridgeServer:
    """Listens for stations and sends them packets and signs of life.

    The address is a host and port (0: any free one), or the path of a local socket.

    Raises:
        InvalidInputError: the address is in use or not one of this host.
    """

    def __init__(
        self, hello: BridgeHello, address: tuple[str, int] | Path, *, clock: StationClock
    ) -> None:
        self.summary = Summary()
        self._hello, self._clock = hello, clock
        self._expect_devices()
        self._path: Path | None = None
        self._lock = threading.Lock()
        self._stations: list[StationLink] = []
        self._sequence = 0
        self._last_ns: dict[str, int] = {}
        self._sent_ns = 0
        self._delays_ns = (0, 0, 0)
        self._is_closed = threading.Event()
        self._listener = self._listen(address)
        self._life = PeriodicCall(
            self._show_life, period_ns=LIFE_PERIOD_NS // 2, clock=clock, name="bridge-life"
        )
        self._life.start()
        threading.Thread(target=self._accept, name="bridge-accept", daemon=True).start()

    @property
    def address(self) -> str:
        """Where stations connect, for people and, if it is a port, its number at the end."""
        if self._path is not None:
            return str(self._path)
        host, port = self._listener.getsockname()[:2]
        return f"{host}:{port}"

    def announce(self, hello: BridgeHello) -> None:
        """Say another hello: stations must connect again if the devices are others now."""
        if hello != self._hello:
            self._hello = hello
            self._expect_devices()
            with self._lock:
                for station in self._stations:
                    station.close()

    def send(self, reading: Reading, *, has_station_time: bool) -> None:
        """Send a reading to all stations, unless its stamp does not advance; never waits for one.

        A stamp that goes back by more than a second is a clock that started anew.
        """
        device, t_ns = reading.device, reading.t_device_ns
        # Packets have no such times: a negative one is from before the clock's start.
        if not 0 <= t_ns <= MAX_STAMP_NS:
            self.summary.old[device] += 1
            return
        last_ns = self._last_ns.get(device)
        if last_ns is not None and t_ns <= last_ns:
            if t_ns >= last_ns - RESTART_NS:
                self.summary.old[device] += 1
                return
            self.summary.restarts[device] += 1
        self._last_ns[device] = t_ns
        self._put(reading.place, t_ns, reading.payload)
        self.summary.sent[device] += 1
        if has_station_time:
            delay_ns, (count, least_ns, sum_ns) = self._sent_ns - t_ns, self._delays_ns
            least_ns = min(delay_ns, least_ns) if count else delay_ns
            self._delays_ns = (count + 1, least_ns, sum_ns + delay_ns)
            self.summary.delay_ms = (least_ns / 1e6, (sum_ns + delay_ns) / (count + 1) / 1e6)

    def close(self) -> None:
        """End all connections and stop listening."""
        self._is_closed.set()
        self._life.stop()
        with contextlib.suppress(OSError):  # the thread that accepts is woken by this alone
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            for station in self._stations:
                station.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _expect_devices(self) -> None:
        self.summary.sent.update({device.serial_number: 0 for device in self._hello.devices})

    def _put(self, place: int, t_device_ns: int, payload: bytes) -> None:
        with self._lock:
            packet = Packet(VERSION, place, self._sequence, t_device_ns, payload)
            data = encode_packet(MAGICS[self._hello.kind], packet)
            self._sequence += 1
            self._sent_ns = self._clock.now_ns()
            self._stations = [station for station in self._stations if station.is_open]
            self.summary.dropped += sum(station.put(data) for station in self._stations)

    def _show_life(self) -> None:
        if self._clock.now_ns() - self._sent_ns >= LIFE_PERIOD_NS:
            self._put(SOURCES["none"], max(self._last_ns.values(), default=0), b"")

    def _listen(self, address: tuple[str, int] | Path) -> socket.socket:
        try:
            if not isinstance(address, Path):
                return socket.create_server(address, backlog=MAX_STATIONS)
            _clear_path(address)
            listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                listener.bind(str(address))
                listener.listen(MAX_STATIONS)
            except OSError:
                listener.close()
                raise
        except OSError as error:
            raise InvalidInputError(
                f"cannot listen at {address}: {error}; choose another --port or --path"
            ) from error
        self._path = address
        return listener

    def _accept(self) -> None:
        while not self._is_closed.is_set():
            try:
                link, _ = self._listener.accept()
                try:
                    self._welcome(link)
                except OSError:
                    link.close()
                    raise
            # Closed, the station is gone again, or too many files are open.
            except OSError:
                self._is_closed.wait(ACCEPT_RETRY_S)

    def _welcome(self, link: socket.socket) -> None:
        with self._lock:
            self._stations = [station for station in self._stations if station.is_open]
            if len(self._stations) == MAX_STATIONS:
                link.close()
                return
            link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
            if self._path is None:
                link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            line = json.dumps(self._hello.model_dump(mode="json", exclude_none=True))
            self._stations.append(StationLink(link, line.encode() + b"\n"))


def run_bridge(
    source: Source,
    address: tuple[str, int] | Path,
    *,
    stop: threading.Event,
    say: Say,
) -> Summary:
    """Serve a source until `stop` is set, opening it again whenever it is lost.

    It listens as soon as the source was opened once. While the source is away, stations get signs
    of life and no samples. The address is as of `BridgeServer`; `say` shows a line to people.

    Raises:
        InvalidInputError: nothing can listen at the address.
        UnavailableError: the SDK's library is not installed.
    """
    clock = StationClock()
    start_ns = clock.now_ns()
    server: BridgeServer | None = None
    try:
        while not stop.is_set():
            try:
                hello = source.open()
                if server is None:
                    server = BridgeServer(hello, address, clock=clock)
                server.announce(hello)
                devices = ", ".join(f"{d.serial_number} ({d.source})" for d in hello.devices)
                say(f"{hello.software}: serving {devices} at {server.address}")
                say(f"clock: {source.clock}")
                while not stop.is_set():
                    for reading in source.read():
                        server.send(reading, has_station_time=source.has_station_time)
            except DeviceError as error:
                say(f"{error.message}; trying again every {RETRY_S:.0f} s")
                source.close()
                stop.wait(RETRY_S)
    finally:
        source.close()
        if server is not None:
            server.close()
    summary = Summary() if server is None else server.summary
    summary.seconds = (clock.now_ns() - start_ns) / 1e9
    summary.not_sent = dict(source.not_sent)
    return summary
