"""Numbered 64-byte reports ↔ a packet's bytes, and the decoders of trackers that send them."""

import struct

from dextouch.errors import InvalidInputError
from dextouch.streams import StreamDescriptor
from services.acquisition.drivers.base import Readings, StreamDecoder
from services.acquisition.drivers.packets import Packet, PacketDecoder

REPORT_BYTES = 64
DATA_REPORT = 0x01
DESCRIPTOR_REPORT = 0x02
# report id, message counter, part, number of parts, bytes of payload in this part
REPORT_HEADER = struct.Struct("<BBBBB")
PART_BYTES = REPORT_BYTES - REPORT_HEADER.size
MAX_PARTS = 255


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


class ReportReassembler:
    """Joins the parts of one message; a missing part costs that message alone.

    Attributes:
        num_reports: how many came.
        num_incomplete: messages of which a part was missing.
    """

    def __init__(self) -> None:
        self.num_reports = self.num_incomplete = 0
        self._parts: list[bytes] = []
        self._key = (0, 0, 0)

    def reset(self) -> None:
        """Forget half a message."""
        self.num_incomplete += bool(self._parts)
        self._parts = []

    def feed(self, report: bytes) -> tuple[int, bytes] | None:
        """(report id, message) when this report completes one; None of one that is malformed."""
        self.num_reports += 1
        if len(report) != REPORT_BYTES:
            return None
        report_id, counter, part, num_parts, length = REPORT_HEADER.unpack_from(report)
        key = (report_id, counter, num_parts)
        if part >= num_parts or length > PART_BYTES:
            return None
        if part == 0:
            self.reset()
            self._key = key
        elif part != len(self._parts) or key != self._key:
            self.reset()
            return None
        self._parts.append(report[REPORT_HEADER.size : REPORT_HEADER.size + length])
        if part + 1 < num_parts:
            return None
        message, self._parts = b"".join(self._parts), []
        return report_id, message


class ReportDecoder(StreamDecoder[Packet]):
    """Base of the decoders of trackers by HID or USB, whose packets come in reports.

    Args:
        descriptor: of the stream.
        packets: finds the packets in joined reports.
    """

    def __init__(self, descriptor: StreamDescriptor, packets: PacketDecoder) -> None:
        super().__init__(descriptor, packets)
        self.reports = ReportReassembler()

    def reset(self) -> None:
        """Forget half a message; another device may answer now."""
        super().reset()
        self.reports.reset()

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
        return True
