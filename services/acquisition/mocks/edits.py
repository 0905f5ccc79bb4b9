"""Faults inside packets: pinned cells, NaN, another hand or version.

Each family of packets has its own `PacketEdits`. What a family cannot say (a hand, a version)
cannot be said wrongly either: such a fault is refused.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from dextouch.errors import InvalidInputError
from services.acquisition.drivers.packets import (
    CRC,
    HEADER,
    MAGIC_SIZE,
    SOURCES,
    VERSION,
    Packet,
    encode_packet,
)
from services.acquisition.drivers.reports import (
    REPORT_BYTES,
    REPORT_HEADER,
    ReportReassembler,
    split_into_reports,
)

OUR_MAGIC = b"DX"
FINGER_MAGIC = b"DXFT"
# Where the numbers of a payload begin, and what they are.
FLOATS = {
    FINGER_MAGIC: (4, "<f4"),
    b"DXPT": (4, "<f4"),
    b"DXPM": (16, "<f4"),
    b"DXRS": (0, "<f8"),
}
OTHER_SIDE = {SOURCES["left"]: SOURCES["right"], SOURCES["right"]: SOURCES["left"]}

Edit = Callable[[bytes], bytes]
Pinned = Literal["stuck", "saturated"]


class PacketEdits:
    """Faults inside one packet; a family overrides those that its devices can have.

    The last four methods take the bytes of one whole packet and give those of the changed one, its
    checksum right. Those that are not overridden raise InvalidInputError.
    """

    def apply(self, units: Sequence[bytes], edits: Sequence[Edit]) -> list[bytes]:
        """The units that a port sends for one packet, after edits of the packet."""
        # Behind a glove's packet may stand the reply to a command.
        return [_edited(units[0], edits), *units[1:]] if edits else list(units)

    def is_marked_when_nan(self, units: Sequence[bytes]) -> bool:
        """Whether a driver records a NaN as a missing part of a sample, and refuses no packet."""
        del units
        return False

    def pin(self, data: bytes, cells: Sequence[int], how: Pinned) -> bytes:
        """Raw cells of a glove that show the same whatever presses them."""
        del data, cells, how
        raise _cannot("a taxel that is pinned")

    def put_nan(self, data: bytes) -> bytes:
        """The first number that is one is none."""
        del data
        raise _cannot("a number that can be NaN")

    def other_side(self, data: bytes) -> bytes:
        """The packet of the other hand's device."""
        del data
        raise _cannot("a hand")

    def other_version(self, data: bytes) -> bytes:
        """The packet of a device with newer firmware."""
        del data
        raise _cannot("a version")


class OurPacketEdits(PacketEdits):
    """Faults inside the packets of our documented devices (docs/device_packets.md)."""

    def apply(self, units: Sequence[bytes], edits: Sequence[Edit]) -> list[bytes]:
        """Joins the reports of a packet for the edits, and splits it again.

        Raises:
            InvalidInputError: reports that are no whole packet.
        """
        if not edits or not _is_report(units[0]):
            return super().apply(units, edits)
        reports = ReportReassembler()
        messages = [m for m in map(reports.feed, units) if m is not None]
        if len(messages) != 1:
            raise InvalidInputError(
                f"mock fault: got {len(units)} reports, expected one whole packet"
            )
        report_id, data = messages[0]
        counter = REPORT_HEADER.unpack_from(units[0])[1]
        return split_into_reports(report_id, counter, _edited(data, edits))

    def is_marked_when_nan(self, units: Sequence[bytes]) -> bool:
        """Finger trackers alone say of single nodes that they are not seen."""
        start = REPORT_HEADER.size if _is_report(units[0]) else 0
        return units[0].startswith(FINGER_MAGIC, start)

    def put_nan(self, data: bytes) -> bytes:
        """The first number of a payload of floats."""

        def change(magic: bytes, packet: Packet) -> Packet:
            if magic not in FLOATS:
                raise _cannot("a number that can be NaN")
            start, dtype = FLOATS[magic]
            values = without_first(np.frombuffer(packet.payload, dtype=dtype, offset=start))
            return replace(packet, payload=packet.payload[:start] + values.tobytes())

        return edit_ours(data, change)

    def other_side(self, data: bytes) -> bytes:
        """Left says right, and any other left."""
        return edit_ours(
            data, lambda _, p: replace(p, source=OTHER_SIDE.get(p.source, SOURCES["left"]))
        )

    def other_version(self, data: bytes) -> bytes:
        """The next version."""
        return edit_ours(data, lambda _, p: replace(p, version=VERSION + 1))


def halve_units(units: Sequence[bytes]) -> list[bytes]:
    """The first half of a packet's bytes, or of its reports."""
    if len(units) > 1:
        return list(units[: len(units) // 2])
    whole = units[0]
    return [whole[: len(whole) // 2]]


def without_first(values: np.ndarray) -> np.ndarray:
    """The numbers with NaN in place of the first that is finite."""
    values = values.copy()
    values[np.flatnonzero(np.isfinite(values))[0]] = np.nan
    return values


def edit_ours(data: bytes, change: Callable[[bytes, Packet], Packet]) -> bytes:
    """A packet of our documented devices after a change of its content.

    Raises:
        InvalidInputError: no such packet, or a fault that this one cannot have.
    """
    magic = data[:MAGIC_SIZE]
    if not magic.startswith(OUR_MAGIC):
        raise InvalidInputError(
            f"mock fault: got a packet that begins with {magic!r}, expected one of ours; give its "
            "source PacketEdits of its family"
        )
    _, version, source, length, sequence, t_device_ns = HEADER.unpack_from(data)
    payload = data[HEADER.size : len(data) - CRC.size]
    packet = Packet(version, source, sequence, t_device_ns, payload[:length])
    return encode_packet(magic, change(magic, packet))


def _cannot(what: str) -> InvalidInputError:
    return InvalidInputError(
        f"mock fault: packets of this family do not tell {what}; leave the fault out of the script"
    )


def _is_report(unit: bytes) -> bool:
    return len(unit) == REPORT_BYTES and not unit.startswith(OUR_MAGIC)


def _edited(data: bytes, edits: Sequence[Edit]) -> bytes:
    for edit in edits:
        data = edit(data)
    return data
