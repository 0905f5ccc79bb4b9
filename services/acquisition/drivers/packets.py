"""The one packet frame of our documented devices: bytes in any portions ↔ checked packets."""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dextouch.errors import InvalidInputError
from services.acquisition.drivers.packet_search import FrameSearch, SequenceCounter

# magic, version, source, payload length, sequence, device time in ns (docs/device_packets.md)
HEADER = struct.Struct("<4sBBIIQ")
CRC = struct.Struct("<I")
OVERHEAD = HEADER.size + CRC.size
VERSION = 1
MAGIC_SIZE = 4
SEQUENCE_BITS = 32
SEQUENCE_MODULUS = 1 << SEQUENCE_BITS
SOURCES = {"none": 0, "left": 1, "right": 2, "head": 3}


@dataclass(slots=True)
class Packet:
    """One packet whose checksum held; nobody changes it (frozen, it would cost a µs more)."""

    version: int
    source: int
    sequence: int
    t_device_ns: int
    payload: bytes
    magic: bytes = b""


def encode_packet(magic: bytes, packet: Packet) -> bytes:
    """Bytes of a packet (what a device sends)."""
    if len(magic) != MAGIC_SIZE:
        raise InvalidInputError(f"magic: got {magic!r}, expected {MAGIC_SIZE} bytes")
    body = (
        HEADER.pack(
            magic,
            packet.version,
            packet.source,
            len(packet.payload),
            packet.sequence % SEQUENCE_MODULUS,
            packet.t_device_ns,
        )
        + packet.payload
    )
    return body + CRC.pack(zlib.crc32(body))


class PacketDecoder(FrameSearch[Packet]):
    """Finds packets of our documented devices.

    Args:
        magic: of the kind whose sequence is counted.
        min_payload: smallest payload of this kind in bytes.
        max_payload: largest.
        others: further kinds on the same link with their smallest and largest payloads; their
            packets are returned too, but are not part of the sequence.
    """

    def __init__(
        self,
        magic: bytes,
        *,
        min_payload: int,
        max_payload: int,
        others: Mapping[bytes, tuple[int, int]] | None = None,
    ) -> None:
        self._sizes = {**(others or {}), magic: (min_payload, max_payload)}
        super().__init__(_common_start(list(self._sizes)))
        self._magic = magic
        self._sequence = SequenceCounter(self.statistics, bits=SEQUENCE_BITS)

    def _take(self, data: bytes, position: int) -> tuple[Packet, int] | None:
        start = position + HEADER.size
        if len(data) < start:
            self._needed = start
            return None
        magic, version, source, length, sequence, t_device_ns = HEADER.unpack_from(data, position)
        sizes = self._sizes.get(magic)
        if sizes is None:
            return None
        if not sizes[0] <= length <= sizes[1]:
            self.statistics.length_errors += 1
            return None
        end = start + length
        if len(data) < end + CRC.size:
            self._needed = end + CRC.size
            return None
        # Through a view: images are too large to be copied for their checksum.
        if CRC.unpack_from(data, end)[0] != zlib.crc32(memoryview(data)[position:end]):
            self.statistics.crc_errors += 1
            return None
        if magic == self._magic:
            self._sequence.count(sequence)
        packet = Packet(version, source, sequence, t_device_ns, data[start:end], magic)
        return packet, OVERHEAD + length


def _common_start(magics: Sequence[bytes]) -> bytes:
    """Common prefix of all magics, so that one search finds every kind.

    Raises:
        InvalidInputError: nothing.
    """
    shortest = MAGIC_SIZE
    while len({magic[:shortest] for magic in magics}) > 1:
        shortest -= 1
    if shortest == 0:
        raise InvalidInputError(f"magics {magics}: got no common start, expected one byte or more")
    return magics[0][:shortest]
