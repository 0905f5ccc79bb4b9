"""The one packet frame of our documented devices: bytes in any portions ↔ checked packets."""

import struct
import zlib
from dataclasses import dataclass

from dextouch.errors import InvalidInputError

# magic, version, source, payload length, sequence, device time in ns (docs/device_packets.md)
HEADER = struct.Struct("<4sBBIIQ")
CRC = struct.Struct("<I")
OVERHEAD = HEADER.size + CRC.size
VERSION = 1
MAGIC_SIZE = 4
SEQUENCE_MODULUS = 1 << 32
SOURCES = {"none": 0, "left": 1, "right": 2, "head": 3}


@dataclass(frozen=True)
class Packet:
    """One packet whose checksum held."""

    version: int
    source: int
    sequence: int
    t_device_ns: int
    payload: bytes


@dataclass
class DecoderStatistics:
    """What a decoder has seen; `lost` counts by sequence numbers, between first and last."""

    packets: int = 0
    crc_errors: int = 0
    length_errors: int = 0
    resync_bytes: int = 0
    lost: int = 0
    repeated: int = 0
    restarts: int = 0
    refused: int = 0


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


class PacketDecoder:
    """Finds packets in a byte stream; the result does not depend on how the bytes are portioned.

    After a bad length or checksum the search goes on one byte further, never behind the claimed
    packet, so that a damaged packet costs only itself.
    """

    def __init__(self, magic: bytes, *, min_payload: int, max_payload: int) -> None:
        self.statistics = DecoderStatistics()
        self._magic = magic
        self._min_payload = min_payload
        self._max_payload = max_payload
        self._buffer = bytearray()
        self._needed = 0
        self._last_sequence: int | None = None

    def reset(self) -> None:
        """Forget half a packet (the link was lost); counters and sequence stay."""
        self.statistics.resync_bytes += len(self._buffer)
        self._buffer.clear()
        self._needed = 0

    def feed(self, data: bytes) -> list[Packet]:
        """Packets completed by `data`."""
        buffer = self._buffer
        buffer += data
        if len(buffer) < self._needed:
            return []
        self._needed = 0
        packets: list[Packet] = []
        position = 0
        while True:
            position = self._seek(position)
            if len(buffer) < position + MAGIC_SIZE:
                break
            packet = self._take(position)
            if packet is None and self._needed:
                break
            if packet is None:
                position += 1
                self.statistics.resync_bytes += 1
            else:
                position += OVERHEAD + len(packet.payload)
                packets.append(packet)
        del buffer[:position]
        self._needed = max(0, self._needed - position)
        return packets

    def _seek(self, position: int) -> int:
        found = self._buffer.find(self._magic, position)
        if found < 0:
            found = max(position, len(self._buffer) - MAGIC_SIZE + 1)
        self.statistics.resync_bytes += found - position
        return found

    def _take(self, position: int) -> Packet | None:
        """The packet at `position`; None when there is none, or (`_needed` set) not yet."""
        buffer = self._buffer
        if len(buffer) < position + HEADER.size:
            self._needed = position + HEADER.size
            return None
        _, version, source, length, sequence, t_device_ns = HEADER.unpack_from(buffer, position)
        if not self._min_payload <= length <= self._max_payload:
            self.statistics.length_errors += 1
            return None
        end = position + HEADER.size + length
        if len(buffer) < end + CRC.size:
            self._needed = end + CRC.size
            return None
        body = bytes(buffer[position:end])
        if CRC.unpack_from(buffer, end)[0] != zlib.crc32(body):
            self.statistics.crc_errors += 1
            return None
        self._count(sequence)
        return Packet(version, source, sequence, t_device_ns, body[HEADER.size :])

    def _count(self, sequence: int) -> None:
        self.statistics.packets += 1
        if self._last_sequence is not None:
            step = (sequence - self._last_sequence) % SEQUENCE_MODULUS
            if step == 0:
                self.statistics.repeated += 1
            elif step < SEQUENCE_MODULUS // 2:
                self.statistics.lost += step - 1
            else:
                self.statistics.restarts += 1
        self._last_sequence = sequence
