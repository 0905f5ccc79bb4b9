"""Packets in a byte stream that comes in arbitrary reads: search, order, and our own frame."""

import struct
import zlib
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

Found = TypeVar("Found")

# Packets that overtake each other do so within a few; a restarted device jumps further.
LATE_PACKETS = 64
# Where few packets have come, those this much earlier may still be late ones.
MIN_LATE_NS = 1_000_000_000
# magic, version, source, payload length, sequence, device time in ns (docs/device_packets.md)
HEADER = struct.Struct("<4sBBIIQ")
CRC = struct.Struct("<I")
OVERHEAD = HEADER.size + CRC.size
VERSION = 1
MAGIC_SIZE = 4
SEQUENCE_BITS = 32
# Batches hold no larger one; no device runs for 292 years.
MAX_STAMP_NS = 2**63 - 1
SEQUENCE_MODULUS = 1 << SEQUENCE_BITS
SOURCES = {"none": 0, "left": 1, "right": 2, "head": 3}
SOURCE_NAMES = {number: name for name, number in SOURCES.items()}


@dataclass
class DecoderStatistics:
    """What a decoder has seen; `lost` counts by sequence numbers, between first and last.

    A packet that was overtaken is `lost` until it comes, from then on `late`: `lost` may shrink.
    `suspects` are packets that were held back although all that their family checks held: their
    numbers cannot be readings, or their stamp no time.
    """

    packets: int = 0
    crc_errors: int = 0
    length_errors: int = 0
    resync_bytes: int = 0
    lost: int = 0
    late: int = 0
    repeated: int = 0
    restarts: int = 0
    refused: int = 0
    suspects: int = 0


class SequenceCounter:
    """Counts lost, late and repeated packets and restarts by a sequence number of so many bits.

    A decreasing number is a late packet if it is missing among the last 64 and its time of the
    device is not before theirs, a repeated one if it came among these at the same time, otherwise
    a restart of the device, once where the number never changes. The frames of a `FrameSearch` that
    are late or repeated are left out, which leaves a gap.
    """

    def __init__(self, statistics: DecoderStatistics, *, bits: int) -> None:
        self._statistics = statistics
        self._modulus = 1 << bits
        self._last: int | None = None
        # Numbers behind the last one that have not come, and whether they are counted as lost.
        self._missing: dict[int, bool] = {}
        # Number and device time of the newest packets.
        self._came: deque[tuple[int, int | None]] = deque(maxlen=LATE_PACKETS)

    def reset(self) -> None:
        """The link was lost: what was overtaken or repeated cannot come any more."""
        self._missing.clear()
        self._came.clear()

    def count(
        self, sequence: int, *, t_device_ns: int | None = None, is_restarted: bool = False
    ) -> None:
        """One packet came.

        `is_restarted`: its clock says that the device started anew, so that the number may be any.
        """
        statistics = self._statistics
        statistics.packets += 1
        came = (sequence, t_device_ns)
        if self._last is None:
            self._begin(sequence)
            self._came.append(came)
            return
        step = (sequence - self._last) % self._modulus
        if sequence in self._missing and self._is_of_this_run(t_device_ns):
            # Its clock steps back, too, which alone would look like a restart.
            statistics.late += 1
            statistics.lost -= self._missing.pop(sequence)
            self._came.append(came)
            return
        if self._is_repeated(came) and not (is_restarted and t_device_ns is None):
            statistics.repeated += 1
            return
        # The newest two packets had this number, too: the device does not count.
        numbers = [number for number, _ in self._came][-2:]
        stands_still = step == 0 and numbers == [sequence, sequence]
        if (0 < step < self._modulus // 2 or stands_still) and not is_restarted:
            statistics.lost += max(0, step - 1)
            self._go_on(sequence, step)
        else:
            statistics.restarts += 1
            self._begin(sequence)
        self._came.append(came)

    def _is_of_this_run(self, t_device_ns: int | None) -> bool:
        """Whether a time can be that of a late packet, and not that of a restarted device."""
        times_ns = [time_ns for _, time_ns in self._came if time_ns is not None]
        if t_device_ns is None or not times_ns:
            return True
        newest_ns = max(times_ns)
        # As long before the oldest of the newest packets as that is before the newest one.
        reach_ns = max(2 * (newest_ns - min(times_ns)), MIN_LATE_NS)
        return newest_ns - reach_ns <= t_device_ns <= newest_ns

    def _is_repeated(self, came: tuple[int, int | None]) -> bool:
        if self._last is None or (self._last - came[0]) % self._modulus >= LATE_PACKETS:
            return False
        if came[1] is None:
            # An earlier number may be that of a restarted device.
            return bool(self._came) and came == self._came[-1]
        return came in self._came

    def _begin(self, sequence: int) -> None:
        """The first packet of a run; those that it overtook nobody missed."""
        self._last = sequence
        before = range(sequence - LATE_PACKETS, sequence)
        self._missing = {number % self._modulus: False for number in before}

    def _go_on(self, sequence: int, step: int) -> None:
        self._last = sequence
        if step > 1:
            skipped = range(sequence - min(step - 1, LATE_PACKETS), sequence)
            self._missing |= {number % self._modulus: True for number in skipped}
        # In the order of their numbers: what can only come too late for anybody goes first.
        while self._missing:
            oldest = next(iter(self._missing))
            if (sequence - oldest) % self._modulus <= LATE_PACKETS:
                break
            del self._missing[oldest]


class PortionedSearch(ABC, Generic[Found]):
    """Collects reads until a search can continue; the result does not depend on the portions.

    What was read at once is searched as it came, without a copy. `_needed` is the length that the
    bytes must have before looking again can find more.
    """

    def __init__(self) -> None:
        self.statistics = DecoderStatistics()
        self._portions: list[bytes] = []
        self._num_waiting = 0
        self._needed = 0

    def reset(self) -> None:
        """Forget half a frame (the link was lost); counters and sequence stay."""
        self.statistics.resync_bytes += self._num_waiting
        self._keep(b"")
        self._needed = 0

    def feed(self, data: bytes) -> list[Found]:
        """Frames completed by `data`."""
        self._portions.append(data)
        self._num_waiting += len(data)
        if self._num_waiting < self._needed:
            return []
        self._needed = 0
        data = b"".join(self._portions)
        found, position = self._search(data)
        self._keep(data[position:])
        self._needed = max(0, self._needed - position)
        return found

    def _keep(self, rest: bytes) -> None:
        self._portions = [rest] if rest else []
        self._num_waiting = len(rest)

    @abstractmethod
    def _search(self, data: bytes) -> tuple[list[Found], int]:
        """What was found in all bytes that wait, and how many of them are done with."""


class FrameSearch(PortionedSearch[Found]):
    """Looks for frames that begin with a mark and are counted by a sequence number.

    After an invalid frame the search continues one byte further, not after its claimed end, so that
    only the damaged frame is lost.

    `_take` gives each sequence number to `self.sequence.count`.
    """

    def __init__(self, mark: bytes, *, sequence_bits: int) -> None:
        super().__init__()
        self._mark = mark
        self.sequence = SequenceCounter(self.statistics, bits=sequence_bits)

    def reset(self) -> None:
        """Forget half a frame (the link was lost); the next number may be any."""
        super().reset()
        self.sequence.reset()

    def _search(self, data: bytes) -> tuple[list[Found], int]:
        found: list[Found] = []
        position = 0
        while (start := data.find(self._mark, position)) >= 0:
            self.statistics.resync_bytes += start - position
            num_old = self.statistics.late + self.statistics.repeated
            taken = self._take(data, start)
            if taken is not None:
                if num_old == self.statistics.late + self.statistics.repeated:
                    found.append(taken[0])
                position = start + taken[1]
            elif self._needed:
                return found, start
            else:
                position = start + 1
                self.statistics.resync_bytes += 1
        # The last bytes may be the first ones of a mark.
        rest = max(position, len(data) - len(self._mark) + 1)
        self.statistics.resync_bytes += rest - position
        return found, rest

    @abstractmethod
    def _take(self, data: bytes, position: int) -> tuple[Found, int] | None:
        """The frame at `position` and its size; None when there is none, or not yet.

        In the latter case `_needed` is set to the length that `data` must have first.
        """


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
    size, sequence = len(packet.payload), packet.sequence % SEQUENCE_MODULUS
    head = HEADER.pack(magic, packet.version, packet.source, size, sequence, packet.t_device_ns)
    body = head + packet.payload
    return body + CRC.pack(zlib.crc32(body))


class PacketDecoder(FrameSearch[Packet]):
    """Finds packets of our documented devices; late and repeated ones are counted and left out.

    Packets of `others`, further kinds on the same link with their smallest and largest payloads in
    bytes, are returned too, but are not part of the sequence.
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
        # One search finds every kind, by the start that their magics share.
        start = magic
        while not all(other.startswith(start) for other in self._sizes):
            start = start[:-1]
        super().__init__(start, sequence_bits=SEQUENCE_BITS)
        self._magic = magic

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
        is_intact = CRC.unpack_from(data, end)[0] == zlib.crc32(memoryview(data)[position:end])
        if not is_intact or t_device_ns > MAX_STAMP_NS:
            self.statistics.crc_errors += not is_intact
            self.statistics.suspects += is_intact
            return None
        if magic == self._magic:
            self.sequence.count(sequence, t_device_ns=t_device_ns)
        packet = Packet(version, source, sequence, t_device_ns, data[start:end], magic)
        return packet, OVERHEAD + length
