"""Driver of our tactile glove: its packets, and the requests for its identity and its time."""

import itertools
import struct
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal, NamedTuple

import numpy as np

from dextouch.clocks import RoundTrip
from dextouch.errors import DeviceError, InvalidInputError, PacketError
from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import DEXTOUCH_V1, Side, TactileLayout
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import DeviceKind, GloveSettings, serial_transport
from services.acquisition.drivers import base
from services.acquisition.drivers.packets import (
    SEQUENCE_MODULUS,
    SOURCE_NAMES,
    SOURCES,
    VERSION,
    Packet,
    PacketDecoder,
    encode_packet,
)
from services.acquisition.transports import Transport

COMMAND_MAGIC = b"DXTC"
REPLY_MAGIC = b"DXTR"
# command, argument (of no command yet: 0)
REQUEST = struct.Struct("<BxH")
# command, status
REPLY_HEAD = struct.Struct("<BBxx")
# serial number, firmware
IDENTITY = struct.Struct("<16s3Bx")
TIME_SYNC = struct.Struct("<Q")
MIN_REPLY, MAX_REPLY = REPLY_HEAD.size, REPLY_HEAD.size + IDENTITY.size
MAGIC = b"DXTG"
_COUNT = np.dtype("<u2")
# Of a `dextouch_v1`.
PAYLOAD_BYTES = _COUNT.itemsize * DEXTOUCH_V1.num_raw_cells
FULL_SCALE_COUNTS = 65_535
ANSWER_TIMEOUT_NS = 300_000_000
NUM_ATTEMPTS = 3
# A virtual clock does not advance while a device is opened; count empty reads instead.
MAX_SILENT_READS = 5


class Command(IntEnum):
    """Commands of the host."""

    IDENTIFY = 1
    TIME_SYNC = 3


class Status(IntEnum):
    """How the device took it."""

    OK = 0
    UNKNOWN_COMMAND = 1
    BAD_ARGUMENT = 2


@dataclass(frozen=True)
class GloveIdentity:
    """Who a glove is."""

    serial_number: str
    firmware: str
    side: str


def encode_request(command: int, *, request: int) -> bytes:
    """Bytes of one request; `request` comes back in the reply's sequence field."""
    packet = Packet(VERSION, SOURCES["none"], request, 0, REQUEST.pack(command, 0))
    return encode_packet(COMMAND_MAGIC, packet)


def encode_reply(
    request: Packet, status: Status, body: bytes, *, source: int, t_device_ns: int
) -> bytes:
    """Bytes of the answer to `request`, sent by the device at `t_device_ns`."""
    payload = REPLY_HEAD.pack(request.payload[0], status) + body
    packet = Packet(VERSION, source, request.sequence, t_device_ns, payload)
    return encode_packet(REPLY_MAGIC, packet)


def parse_reply(packet: Packet) -> tuple[int, Status, bytes]:
    """Command, status and body of a reply.

    Raises:
        PacketError: a status that there is not.
    """
    command, status = REPLY_HEAD.unpack_from(packet.payload)
    if status not in list(Status):
        raise PacketError(f"glove reply: got status {status}, expected {[*map(int, Status)]}")
    return command, Status(status), packet.payload[REPLY_HEAD.size :]


def parse_identity(body: bytes, source: int) -> GloveIdentity:
    """Who the glove says it is.

    Raises:
        PacketError: another size, or a serial number that is no ASCII text.
    """
    serial_bytes, *firmware = _unpacked("identity", IDENTITY, body)
    try:
        serial_number = serial_bytes.rstrip(b"\0").decode("ascii")
    except UnicodeDecodeError as error:
        raise PacketError(f"glove identity: got {serial_bytes!r}, expected ASCII") from error
    side = SOURCE_NAMES.get(source, str(source))
    return GloveIdentity(serial_number, ".".join(map(str, firmware)), side)


def encode_identity(serial_number: str, firmware: tuple[int, int, int]) -> bytes:
    """Body of an identity.

    Raises:
        InvalidInputError: a serial number that does not fit.
    """
    data = serial_number.encode("ascii", errors="replace")
    if not 0 < len(data) <= 16:
        raise InvalidInputError(f"serial number: got {serial_number!r}, expected 1 … 16 letters")
    return IDENTITY.pack(data, *firmware)


def parse_time(body: bytes) -> int:
    """When the glove got the request, on its clock in ns.

    Raises:
        PacketError: another size.
    """
    (t_received_ns,) = _unpacked("time sync", TIME_SYNC, body)
    return int(t_received_ns)


def _unpacked(what: str, layout: struct.Struct, body: bytes) -> tuple[Any, ...]:
    if len(body) != layout.size:
        raise PacketError(f"glove {what}: got {len(body)} bytes, expected {layout.size}")
    return layout.unpack(body)


def glove_descriptor(
    side: Side, label: str | None = None, layout: TactileLayout | None = None
) -> StreamDescriptor:
    """The raw stream of one glove; without a layout it is a `dextouch_v1`.

    Raises:
        InvalidInputError: the layout has readings beyond 16 bits.
    """
    about = DEXTOUCH_V1 if layout is None else layout
    if about.full_scale > FULL_SCALE_COUNTS:
        raise InvalidInputError(
            f"glove_{base.hand_name(side, label)}: got layout {about.name!r} with full_scale "
            f"{about.full_scale:g}, expected at most {FULL_SCALE_COUNTS}, since its packets hold "
            "16 bits a cell"
        )
    return base.glove_stream(
        side,
        label,
        shape=(about.num_raw_cells,),
        dtype="uint16",
        unit=base.raw_unit(about),
        nominal_rate_hz=about.nominal_rate_hz,
        layout=layout,
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )


class TactileGloveDecoder(base.StreamDecoder[Packet]):
    """Decodes one glove's byte stream to uint16 counts [cells] in raw scan order.

    Without a side it takes any glove. `on_reply` takes each reply to a command with its arrival.
    `label` is that of a further glove of this hand, `layout` None of a `dextouch_v1`.
    """

    def __init__(
        self,
        side: Side | None = None,
        *,
        on_reply: Callable[[Packet, int], None] | None = None,
        label: str | None = None,
        layout: TactileLayout | None = None,
    ) -> None:
        # Where the side is open, the stream is named for the left hand.
        descriptor = glove_descriptor(side or "left", label, layout)
        packets = PacketDecoder(
            MAGIC,
            min_payload=descriptor.sample_bytes(),
            max_payload=descriptor.sample_bytes(),
            others={REPLY_MAGIC: (MIN_REPLY, MAX_REPLY)},
        )
        super().__init__(descriptor, packets)
        self._side: Side | None = side
        self._device = f"glove_{'any' if side is None else base.hand_name(side, label)}"
        self._on_reply = on_reply

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        if packet.magic == REPLY_MAGIC:
            if self._on_reply is not None:
                self._on_reply(packet, t_host_ns)
            return None
        base.check_packet(packet, device=self._device, source=self._side)
        counts = np.frombuffer(packet.payload, _COUNT)
        return Sample(t_host_ns, counts, packet.t_device_ns, packet.sequence)


# A reply that is awaited, with its arrival.
Reply = Future[tuple[Packet, int]]


class Answer(NamedTuple):
    """The glove's answer to a request, and when the host asked and was answered."""

    body: bytes
    packet: Packet
    t_asked_host_ns: int
    t_answered_host_ns: int


class TactileGlove(base.Driver):
    """Reads one glove and asks it things.

    Every opening asks who it is: a glove of another serial number or of the other hand is
    refused by name before any sample is taken from it. Without a serial number any is taken.
    `label` is that of a further glove of this hand, `layout` None of a `dextouch_v1`.
    """

    def __init__(
        self,
        side: Side,
        *,
        transport: Transport,
        clock: StationClock,
        serial_number: str | None = None,
        label: str | None = None,
        layout: TactileLayout | None = None,
    ) -> None:
        decoder = TactileGloveDecoder(side, on_reply=self._accept, label=label, layout=layout)
        name = f"glove_{base.hand_name(side, label)}"
        super().__init__(name, transport=transport, decoder=decoder, clock=clock)
        self._side: Side = side
        self._serial_number = serial_number
        self._numbers = itertools.count(1)
        # The requests under way, and the replies to them with their arrivals.
        self._asked: dict[int, Reply] = {}
        self._writing = threading.Lock()
        self._held: base.Readings = {}
        self._reader: int | None = None

    def open(self) -> None:
        """Open the transport and ask the glove who it is.

        Raises:
            DeviceError: absent, silent, or another glove than this one should be.
        """
        self._reader = threading.get_ident()
        self._held = {}
        super().open()
        self._check(self.identify())

    def read(self) -> base.Readings:
        """New samples by stream; those that came during a request of this thread go first."""
        self._reader = threading.get_ident()
        if self._held:
            held, self._held = self._held, {}
            return held
        return super().read()

    def identify(self) -> GloveIdentity:
        """Serial number, firmware and side, as reported by the glove."""
        answer = self._ask(Command.IDENTIFY)
        return parse_identity(answer.body, answer.packet.source)

    def time_round_trip(self) -> RoundTrip:
        """One request for the glove's time; `dextouch.clocks.RoundTripClock` takes many of them."""
        body, packet, t_asked_ns, t_answered_ns = self._ask(Command.TIME_SYNC)
        return RoundTrip(t_asked_ns, parse_time(body), packet.t_device_ns, t_answered_ns)

    def _check(self, identity: GloveIdentity) -> None:
        where = f"{self.name}: the glove {identity.serial_number!r} at {self.info.address}"
        if self._serial_number not in (None, identity.serial_number):
            raise DeviceError(
                f"{where} is not {self._serial_number!r}; are two gloves swapped, or is the "
                "serial number in the settings that of another glove?",
                device=self.name,
                event="wrong_serial_number",
            )
        if identity.side != self._side:
            raise DeviceError(
                f"{where} says it is {identity.side!r}, expected {self._side!r}; left and right "
                "are swapped: swap the gloves or their entries in the settings",
                device=self.name,
                event="wrong_side",
            )

    def _ask(self, command: Command) -> Answer:
        for _ in range(NUM_ATTEMPTS):
            number = next(self._numbers) % SEQUENCE_MODULUS
            reply = self._asked[number] = Future()
            try:
                with self._writing:
                    t_asked_ns = self._clock.now_ns()
                    self.transport.write(encode_request(command, request=number))
                packet, t_answered_ns = self._await(reply)
            except TimeoutError:
                continue
            finally:
                # Also replies that arrive too late: a station sends requests for months.
                del self._asked[number]
            return Answer(self._body(command, packet), packet, t_asked_ns, t_answered_ns)
        raise DeviceError(
            f"{self.name}: no answer to {command.name.lower()} from {self.info} in "
            f"{NUM_ATTEMPTS} attempts; is it a glove of this protocol?",
            device=self.name,
        )

    def _await(self, reply: Reply) -> tuple[Packet, int]:
        """The reply; read here if this is the reading thread, else that one brings it."""
        if self._reader not in {None, threading.get_ident()}:
            return reply.result(ANSWER_TIMEOUT_NS * 1e-9)
        end_ns, num_silent = self._clock.now_ns() + ANSWER_TIMEOUT_NS, 0
        while not reply.done() and num_silent < MAX_SILENT_READS and self._clock.now_ns() <= end_ns:
            data = self.transport.read()
            num_silent = 0 if data else num_silent + 1
            if data:
                for name, samples in self.decoder.decode(data, self._clock.now_ns()).items():
                    self._held.setdefault(name, []).extend(samples)
        return reply.result(0)

    def _accept(self, packet: Packet, t_host_ns: int) -> None:
        """A reply came (called by the decoder); unexpected replies are ignored."""
        reply = self._asked.get(packet.sequence)
        if reply is not None and not reply.done():
            reply.set_result((packet, t_host_ns))

    def _body(self, command: Command, packet: Packet) -> bytes:
        answered, status, body = parse_reply(packet)
        if answered != command:
            raise DeviceError(
                f"{self.name}: answered command {answered}, expected {int(command)}",
                device=self.name,
            )
        if status is not Status.OK:
            raise DeviceError(
                f"{self.name}: refused {command.name.lower()} with {status.name.lower()}; does its "
                "firmware know the command?",
                device=self.name,
            )
        return body


class TactileGloveSettings(GloveSettings):
    """Our glove on a serial line.

    With serial number and port, the port is opened and the glove there must say that it has the
    number.
    """

    kind: Literal["tactile_glove"] = "tactile_glove"


def build(settings: TactileGloveSettings, clock: StationClock) -> TactileGlove:
    """The driver of one glove."""
    return TactileGlove(
        settings.side,
        transport=serial_transport(settings, device=settings.device),
        clock=clock,
        serial_number=settings.serial_number,
        label=settings.label,
        layout=settings.read_layout(),
    )


KIND = DeviceKind(
    name="tactile_glove",
    settings=TactileGloveSettings,
    build=build,
    mock="services.acquisition.mocks.gloves:mock_glove",
)
