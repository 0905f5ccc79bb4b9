"""A packet larger than a HID report: numbered 64-byte reports ↔ the packet's bytes."""

import struct
from dataclasses import dataclass

from dextouch.errors import InvalidInputError

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
        if not (part < num_parts and length <= PART_BYTES):
            self.statistics.malformed += 1
            return None
        key = (report_id, counter, num_parts)
        if part == 0:
            self.reset()
            self._key = key
        elif key != self._key or part != len(self._parts):
            self.reset()
            return None
        self._parts.append(report[REPORT_HEADER.size : REPORT_HEADER.size + length])
        if len(self._parts) < num_parts:
            return None
        message = b"".join(self._parts)
        self._parts = []
        return report_id, message
