"""Requests that our glove answers, and its replies: their layout in bytes."""

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import UInt16

from dextouch.errors import InvalidInputError, PacketError
from dextouch.tactile.layout import NUM_RAW_TAXELS
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet

COMMAND_MAGIC = b"DXTC"
REPLY_MAGIC = b"DXTR"
# command, argument
REQUEST = struct.Struct("<BxH")
# command, status
REPLY_HEAD = struct.Struct("<BBxx")
# serial number, firmware
IDENTITY = struct.Struct("<16s3Bx")
# uptime in ns, packets made, damaged requests, resets of the link
DIAGNOSTICS = struct.Struct("<QIII")
TIME_SYNC = struct.Struct("<Q")
TARE_BYTES = 2 * NUM_RAW_TAXELS
MIN_REPLY, MAX_REPLY = REPLY_HEAD.size, REPLY_HEAD.size + TARE_BYTES
MAX_TARE_PACKETS = 600


class Command(IntEnum):
    """Commands of the host."""

    IDENTIFY = 1
    DIAGNOSTICS = 2
    TIME_SYNC = 3
    TARE = 4


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


@dataclass(frozen=True)
class GloveDiagnostics:
    """Counters of a glove since it started."""

    uptime_ns: int
    packets: int
    crc_errors: int
    resets: int


def encode_request(command: int, *, argument: int, request: int) -> bytes:
    """Bytes of one request; `request` comes back in the reply's sequence field."""
    packet = Packet(VERSION, SOURCES["none"], request, 0, REQUEST.pack(command, argument))
    return encode_packet(COMMAND_MAGIC, packet)


def encode_reply(request: Packet, status: Status, body: bytes, *, made: Packet) -> bytes:
    """Bytes of the answer to `request`; `made` gives the device's source and time."""
    payload = REPLY_HEAD.pack(request.payload[0], status) + body
    packet = Packet(VERSION, made.source, request.sequence, made.t_device_ns, payload)
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
    _check_size("identity", body, IDENTITY.size)
    serial_bytes, *firmware = IDENTITY.unpack(body)
    try:
        serial_number = serial_bytes.rstrip(b"\0").decode("ascii")
    except UnicodeDecodeError as error:
        raise PacketError(f"glove identity: got {serial_bytes!r}, expected ASCII") from error
    sides = {number: name for name, number in SOURCES.items()}
    return GloveIdentity(
        serial_number, ".".join(map(str, firmware)), sides.get(source, str(source))
    )


def encode_identity(serial_number: str, firmware: tuple[int, int, int]) -> bytes:
    """Body of an identity.

    Raises:
        InvalidInputError: a serial number that does not fit.
    """
    data = serial_number.encode("ascii", errors="replace")
    if not 0 < len(data) <= 16:
        raise InvalidInputError(f"serial number: got {serial_number!r}, expected 1 … 16 letters")
    return IDENTITY.pack(data, *firmware)


def parse_diagnostics(body: bytes) -> GloveDiagnostics:
    """The glove's own counters.

    Raises:
        PacketError: another size.
    """
    _check_size("diagnostics", body, DIAGNOSTICS.size)
    return GloveDiagnostics(*DIAGNOSTICS.unpack(body))


def parse_time(body: bytes) -> int:
    """When the glove got the request, on its clock in ns.

    Raises:
        PacketError: another size.
    """
    _check_size("time sync", body, TIME_SYNC.size)
    (t_received_ns,) = TIME_SYNC.unpack(body)
    return int(t_received_ns)


def parse_tare(body: bytes) -> UInt16[np.ndarray, "360"]:
    """Mean counts of each raw cell without load.

    Raises:
        PacketError: another size.
    """
    _check_size("tare", body, TARE_BYTES)
    return np.frombuffer(body, dtype="<u2")


def _check_size(what: str, body: bytes, size: int) -> None:
    if len(body) != size:
        raise PacketError(f"glove {what}: got {len(body)} bytes, expected {size}")
