"""The protocol between a station and the process that holds a closed SDK.

The bytes are documented in docs/device_packets.md, "Bridges".
"""

from abc import abstractmethod
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, ValidationError, model_validator

from dextouch.errors import DeviceError, StaleDataError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems
from dextouch.streams import Sample, StreamDescriptor
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver, Readings, StreamDecoder, check_packet
from services.acquisition.drivers.packets import Packet, PacketDecoder
from services.acquisition.transports import Transport

PROTOCOL: Final = "dextouch-bridge"
PROTOCOL_VERSION = 1
MAX_HELLO_BYTES = 16384
MAX_AGE_NS = 200_000_000
# A larger decrease of the clock is a restart; a smaller one is an old sample.
RESTART_NS = 1_000_000_000
# How fast a source's clock may drift away from the host's before its data counts as old.
MAX_DRIFT_PPM = 200
# Chosen: a packet of 8 KiB, as many numbers as a large tactile array has cells.
MAX_CHANNELS = 1024
# Letters of the name of a bridge's software; chosen: a name, a version and a path.
MAX_SOFTWARE = 256
LENGTH_UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}

# Why packets of a tracker become no sample.
DROPPED = ("occluded", "jumped", "stale")

BridgeKind = Literal["finger_tracker", "pose_tracker", "numbers"]
SignedAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
HELLO_READS = 20
SILENCE_NS = 200_000_000


class BridgedDevice(FrozenModel):
    """One device behind a bridge: its index in packets, serial number and place."""

    index: int = Field(ge=0, le=65535)
    serial_number: str = Field(min_length=1, max_length=128)
    source: Literal["left", "right", "head", "none"]


class FrameConvention(FrozenModel):
    """Orientation of the sender's coordinates in ours.

    `axes` says for the sender's x, y and z in turn which axis of our frame points the same way.
    `handedness` says the same again in one word; a convention that contradicts itself is refused.
    """

    handedness: Literal["left", "right"]
    axes: tuple[SignedAxis, SignedAxis, SignedAxis]

    @model_validator(mode="after")
    def _agrees(self) -> "FrameConvention":
        if {axis[1] for axis in self.axes} != {"x", "y", "z"}:
            raise ValueError(f"axes: got {self.axes}, expected each of x, y and z once")
        handedness = "right" if np.linalg.det(self.ours_from_theirs()) > 0 else "left"
        if handedness != self.handedness:
            raise ValueError(
                f"axes {self.axes} are {handedness}-handed, but handedness says {self.handedness}"
            )
        return self

    def ours_from_theirs(self) -> Float64[np.ndarray, "3 3"]:
        """The matrix M (a signed permutation) with p_ours = M p_theirs; det −1 if left-handed."""
        matrix = np.zeros((3, 3))
        for column, axis in enumerate(self.axes):
            matrix["xyz".index(axis[1]), column] = 1.0 if axis[0] == "+" else -1.0
        return matrix


class BridgeHello(FrozenModel):
    """The first line of every connection."""

    protocol: Literal["dextouch-bridge"]
    version: int
    kind: BridgeKind
    software: str = Field(max_length=MAX_SOFTWARE)
    devices: tuple[BridgedDevice, ...] = Field(min_length=1)
    frame: FrameConvention
    length_unit: Literal["m", "cm", "mm"]
    nodes: tuple[tuple[str, str], ...] | None = None
    channels: int | None = Field(default=None, ge=1, le=MAX_CHANNELS)

    @model_validator(mode="after")
    def _tells_devices_apart(self) -> "BridgeHello":
        names = ["index", "serial_number"]
        if self.kind != "pose_tracker":
            # Packets of poses alone carry the index: of others the source says whose they are.
            names.append("source")
        for name in names:
            values = [getattr(device, name) for device in self.devices]
            if len(set(values)) < len(values):
                raise ValueError(f"devices: {name} {values} are not all different")
        if (self.nodes is None) is (self.kind == "finger_tracker"):
            raise ValueError("nodes: needed from a finger tracker, and from nothing else")
        if (self.channels is None) is (self.kind == "numbers"):
            raise ValueError("channels: needed from a source of numbers, and from nothing else")
        return self

    def scale_m(self) -> float:
        """Metres of the sender's unit of length."""
        return LENGTH_UNITS_M[self.length_unit]


def parse_hello(line: bytes, *, device: str) -> BridgeHello:
    """The hello of a bridge.

    Raises:
        DeviceError: no such hello, or one of another version.
    """
    try:
        hello = BridgeHello.model_validate_json(line)
    except ValidationError as error:
        raise DeviceError(
            f"{device}: the bridge's first line is no {PROTOCOL!r} hello "
            f"({first_problems(error)}); is this the address of a bridge?",
            device=device,
            event="wrong_hello",
        ) from error
    if hello.version != PROTOCOL_VERSION:
        raise DeviceError(
            f"{device}: the bridge uses version {hello.version}, expected {PROTOCOL_VERSION}; "
            "update the bridge or this station",
            device=device,
            event="wrong_version",
        )
    return hello


class FreshnessGate:
    """Decides whether a sample is new: its timestamp advances and is at most 200 ms old.

    The source's clock has an arbitrary origin, so the age is measured relative to the fastest
    sample so far; that reference may drift by 200 ppm. A delay that existed when the connection
    began cannot be detected. Stamps that advance for 200 ms behind the newest one are of a clock
    that was set: what waited somewhere does not come for so long.
    """

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._t_host_ns = 0
        self._t_device_ns = 0
        # The last stamp behind the newest one, and since when such stamps advance.
        self._behind: tuple[int, int] | None = None

    def reset(self) -> None:
        """Another source, or the same one after a restart, may follow."""
        self._offset_ns = None

    def admits(self, t_device_ns: int, t_host_ns: int) -> bool:
        """Whether a sample taken at `t_device_ns` that arrived at `t_host_ns` is new."""
        delay_ns = float(t_host_ns - t_device_ns)
        if self._offset_ns is None or t_device_ns < self._t_device_ns - RESTART_NS:
            self._offset_ns = delay_ns
        elif t_device_ns <= self._t_device_ns:
            last_ns, since_ns = self._behind or (t_device_ns, t_host_ns)
            since_ns = since_ns if t_device_ns > last_ns else t_host_ns
            self._behind = t_device_ns, since_ns
            if t_host_ns - since_ns < MAX_AGE_NS:
                return False
            self._offset_ns = delay_ns
        else:
            drift_ns = (t_host_ns - self._t_host_ns) * (MAX_DRIFT_PPM * 1e-6)
            self._offset_ns = min(delay_ns, self._offset_ns + drift_ns)
        self._t_host_ns, self._t_device_ns, self._behind = t_host_ns, t_device_ns, None
        return delay_ns - self._offset_ns <= MAX_AGE_NS


class BridgeDecoder(StreamDecoder[Packet]):
    """Base of the decoders of one device behind a bridge: its hello, and which packets are new.

    Without a serial number the wanted device is the only one of its source. Packets without a
    payload are heartbeats. `statistics` are of all devices of the bridge; `refused` counts packets
    of a wrong size, too.
    """

    def __init__(
        self,
        kind: BridgeKind,
        descriptor: StreamDescriptor,
        *,
        source: str,
        serial_number: str | None,
        magic: bytes,
        payload_bytes: int,
    ) -> None:
        packets = PacketDecoder(magic, min_payload=0, max_payload=payload_bytes)
        super().__init__(descriptor, packets)
        self.hello: BridgeHello | None = None
        self.tracking = dict.fromkeys(DROPPED, 0)
        self._kind, self._device = kind, descriptor.device or descriptor.name
        self._source, self._serial_number = source, serial_number
        self._payload_bytes = payload_bytes
        self._line = bytearray()
        self._freshness = FreshnessGate()

    def events(self) -> dict[str, int]:
        """Packets left out so far, by the reason."""
        return dict(self.tracking)

    def reset(self) -> None:
        """The connection was lost: the next one begins with a hello."""
        super().reset()
        self.hello = None
        self._line.clear()
        self._freshness.reset()

    def feed(self, data: bytes, t_host_ns: int = 0) -> list[Sample]:
        """New samples.

        Raises:
            DeviceError: no hello, another version, or a bridge without the wanted device.
        """
        if self.hello is None:
            data = self._hear_hello(data)
        return super().feed(data, t_host_ns)

    def is_fresh(self, t_device_ns: int, t_host_ns: int) -> bool:
        """Whether a sample is new; one that is not counts as stale."""
        is_new = self._freshness.admits(t_device_ns, t_host_ns)
        self.tracking["stale"] += not is_new
        return is_new

    @abstractmethod
    def _learn(self, hello: BridgeHello, chosen: BridgedDevice) -> None:
        """Take in what a new connection's hello says of the sender and of the wanted device."""

    @abstractmethod
    def _new_sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        """The sample of a new packet of any device of the bridge; None where it gives none."""

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        check_packet(packet, device=self._device, source=None)
        if not packet.payload:
            return None
        if len(packet.payload) != self._payload_bytes:
            self.statistics.refused += 1
            return None
        return self._new_sample(packet, t_host_ns)

    def _hear_hello(self, data: bytes) -> bytes:
        """What follows the hello; nothing while the hello is not whole."""
        self._line += data
        line, found, rest = self._line.partition(b"\n")
        if len(line) > MAX_HELLO_BYTES:
            raise self._error(
                f"the bridge sent {len(line)} bytes without a hello line, expected at most "
                f"{MAX_HELLO_BYTES}; is this the address of a bridge?",
                "wrong_hello",
            )
        if not found:
            return b""
        self._line = bytearray()
        hello = parse_hello(bytes(line), device=self._device)
        chosen = self._choose(hello)
        self.hello = hello
        self._learn(hello, chosen)
        return bytes(rest)

    def _choose(self, hello: BridgeHello) -> BridgedDevice:
        present = ", ".join(f"{d.serial_number} ({d.source})" for d in hello.devices)
        if hello.kind != self._kind:
            raise self._error(
                f"the bridge is a {hello.kind}, expected a {self._kind}", "wrong_hello"
            )
        serial_number = self._serial_number
        if serial_number is not None:
            found = [d for d in hello.devices if d.serial_number == serial_number]
        else:
            found = [d for d in hello.devices if d.source == self._source]
        if len(found) > 1:
            raise self._error(
                f"several devices are {self._source!r}; set serial_number to one of: {present}",
                "ambiguous_device",
            )
        if not found and serial_number is not None:
            raise self._error(
                f"the bridge has no device {serial_number!r}; present: {present}", "absent_device"
            )
        if not found or found[0].source != self._source:
            raise self._error(
                f"the bridge has {present}, expected {self._source!r}; is the wrong one connected?",
                "wrong_side",
            )
        return found[0]

    def _error(self, text: str, event: str) -> DeviceError:
        return DeviceError(f"{self._device}: {text}", device=self._device, event=event)


class BridgeDriver(Driver):
    """A device behind a bridge: waits for the hello, and takes silence for loss.

    A bridge shows at least every 50 ms that it lives. A bridge that sends nothing for 200 ms has
    stopped or is disconnected, which the socket alone would not indicate for minutes.
    """

    def __init__(
        self, name: str, *, transport: Transport, decoder: BridgeDecoder, clock: StationClock
    ) -> None:
        super().__init__(name, transport=transport, decoder=decoder, clock=clock)
        self._link = decoder
        self._t_heard_ns = 0
        self._first: Readings = {}

    def open(self) -> None:
        """Connect and learn who is there.

        Raises:
            DeviceError: no connection, no hello within 2 s, or another device than requested.
        """
        super().open()
        for _ in range(HELLO_READS):
            self._first = super().read()
            if self._link.hello is not None:
                self._t_heard_ns = self._clock.now_ns()
                return
        raise DeviceError(
            f"{self.name}: {self.info} sends no hello; is this the address of a bridge?",
            device=self.name,
            event="wrong_hello",
        )

    def read(self) -> Readings:
        """New samples; empty when nothing came.

        Raises:
            StaleDataError: the bridge has sent nothing for 200 ms.
            DeviceError: the bridge is disconnected or uses another protocol.
        """
        if self._first:
            first, self._first = self._first, {}
            return first
        # Before the read: a busy host may hold this thread up after it, while data come.
        silence_ns = self._clock.now_ns() - self._t_heard_ns
        data = self.transport.read()
        if data:
            self._t_heard_ns = self._clock.now_ns()
            return self.decoder.decode(data, self._t_heard_ns)
        if silence_ns > SILENCE_NS:
            raise StaleDataError(
                f"{self.name}: {self.info} has sent nothing for {silence_ns / 1e6:.0f} ms, "
                "expected a heartbeat every 50 ms; is the SDK process still running?",
                device=self.name,
                event="silent_bridge",
            )
        return {}
