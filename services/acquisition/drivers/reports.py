"""Trackers whose packets come in numbered 64-byte reports, and which of their packets are new."""

import struct
from dataclasses import dataclass

from dextouch.errors import InvalidInputError
from dextouch.streams import StreamDescriptor
from services.acquisition.drivers.base import Readings, StreamDecoder
from services.acquisition.drivers.packets import SEQUENCE_MODULUS, Packet, PacketDecoder

REPORT_BYTES = 64
DATA_REPORT = 0x01
DESCRIPTOR_REPORT = 0x02
# report id, message counter, part, number of parts, bytes of payload in this part
REPORT_HEADER = struct.Struct("<BBBBB")
PART_BYTES = REPORT_BYTES - REPORT_HEADER.size
MAX_PARTS = 255

# A step back of more than this is a restart of the device, not a packet that came late.
LATE_PACKETS = 8


def split_into_reports(report_id: int, counter: int, data: bytes) -> list[bytes]:
    """Reports that carry `data`, each exactly 64 bytes, padded with zeros.

    Raises:
        InvalidInputError: nothing to send, or more than 255 parts.
    """
    parts = [data[at : at + PART_BYTES] for at in range(0, len(data), PART_BYTES)]
    if not 1 <= len(parts) <= MAX_PARTS:
        raise InvalidInputError(
            f"report: got {len(data)} bytes, expected 1 … {MAX_PARTS * PART_BYTES}"
        )
    return [
        (REPORT_HEADER.pack(report_id, counter % 256, index, len(parts), len(part)) + part).ljust(
            REPORT_BYTES, b"\0"
        )
        for index, part in enumerate(parts)
    ]


@dataclass
class ReassemblyStatistics:
    """What a reassembler has seen."""

    reports: int = 0
    malformed: int = 0
    incomplete: int = 0


class ReportReassembler:
    """Joins the parts of one message; a missing part costs that message alone."""

    def __init__(self) -> None:
        self.statistics = ReassemblyStatistics()
        self._parts: list[bytes] = []
        self._key = (0, 0, 0)

    def reset(self) -> None:
        """Forget half a message."""
        if self._parts:
            self.statistics.incomplete += 1
        self._parts = []

    def feed(self, report: bytes) -> tuple[int, bytes] | None:
        """(report id, message) when this report completes one."""
        self.statistics.reports += 1
        if len(report) != REPORT_BYTES:
            self.statistics.malformed += 1
            return None
        report_id, counter, part, num_parts, length = REPORT_HEADER.unpack_from(report)
        if part >= num_parts or length > PART_BYTES:
            self.statistics.malformed += 1
            return None
        if part == 0:
            self.reset()
            self._key = (report_id, counter, num_parts)
        elif part != len(self._parts) or (report_id, counter, num_parts) != self._key:
            self.reset()
            return None
        self._parts.append(report[REPORT_HEADER.size : REPORT_HEADER.size + length])
        if part + 1 < num_parts:
            return None
        message = b"".join(self._parts)
        self._parts = []
        return report_id, message


class OrderFilter:
    """Lets each packet through once and in order; duplicate and late packets are dropped.

    Repetitions and late packets carry nothing that may become a sample behind a newer one. A larger
    step back is a restart of the device, whose packets are new.
    """

    def __init__(self) -> None:
        self.repeated = 0
        self.late = 0
        self._last: int | None = None

    def reset(self) -> None:
        """Another device, or the same one from the start, may follow."""
        self._last = None

    def counts(self) -> dict[str, int]:
        """Packets dropped so far, by the reason."""
        return {"repeated": self.repeated, "late": self.late}

    def admits(self, sequence: int) -> bool:
        """Whether the packet with this number is newer than those before."""
        if self._last is not None:
            back = (self._last - sequence) % SEQUENCE_MODULUS
            if back == 0:
                self.repeated += 1
                return False
            if back <= LATE_PACKETS:
                self.late += 1
                return False
        self._last = sequence
        return True


class ReportDecoder(StreamDecoder[Packet]):
    """Base of the decoders of trackers by HID or USB, whose packets come in reports.

    Args:
        descriptor: of the stream.
        packets: finds the packets in joined reports.
    """

    def __init__(self, descriptor: StreamDescriptor, packets: PacketDecoder) -> None:
        super().__init__(descriptor, packets)
        self.reports = ReportReassembler()
        self.order = OrderFilter()

    def events(self) -> dict[str, int]:
        """Packets dropped so far, by the reason."""
        return self.order.counts()

    def reset(self) -> None:
        """Forget half a message; another device may answer now."""
        super().reset()
        self.reports.reset()
        self.order.reset()

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Samples completed by one report.

        Raises:
            DeviceError: another version of the device, or another device than expected.
        """
        message = self.reports.feed(data)
        if message is None or not self._is_data(*message):
            return {}
        return super().decode(message[1], t_host_ns)

    def _is_data(self, report_id: int, body: bytes) -> bool:
        """Whether a message is a data packet; what else it is was taken in."""
        del report_id, body
        return True
