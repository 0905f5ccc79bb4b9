"""Units of one packet come in, of any family; the same packet with something else in it goes out.

What a family cannot say (a hand, a version) cannot be said wrongly either: such a fault is refused.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import numpy as np

from dextouch.errors import InvalidInputError
from services.acquisition.drivers.bridge_tracker import POSE_MAGIC as BRIDGE_POSE_MAGIC
from services.acquisition.drivers.finger_tracker import MAGIC as FINGER_MAGIC
from services.acquisition.drivers.glove_justfloat import TAIL
from services.acquisition.drivers.glove_wuji import CRC as WUJI_CRC
from services.acquisition.drivers.glove_wuji import (
    CRC_OFFSET,
    HEAD,
    MARK,
    NUM_CELLS,
    PACKET_BYTES,
    crc16,
)
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
from services.acquisition.drivers.tactile_glove import MAGIC as GLOVE_MAGIC

OUR_MAGIC = b"DX"
# What pinned cells show: counts of our glove, shares of full scale, counts of a justfloat glove.
PINNED = {
    "stuck": {GLOVE_MAGIC: 1_000.0, MARK: 0.25, TAIL: 1_000.0},
    "saturated": {GLOVE_MAGIC: 65_535.0, MARK: 1.0, TAIL: 4_095.0},
}
# Where the numbers of a payload begin, and what they are.
FLOATS = {
    FINGER_MAGIC: (4, "<f4"),
    b"DXPT": (4, "<f4"),
    BRIDGE_POSE_MAGIC: (16, "<f4"),
    b"DXRS": (0, "<f8"),
}
OTHER_SIDE = {SOURCES["left"]: SOURCES["right"], SOURCES["right"]: SOURCES["left"]}

Edit = Callable[[bytes], bytes]


def edit_units(units: Sequence[bytes], edits: Sequence[Edit]) -> list[bytes]:
    """The units of one packet after some edits.

    Raises:
        InvalidInputError: reports that are no whole packet, or an edit its family cannot have.
    """
    if not edits:
        return list(units)
    if not _is_report(units[0]):
        # Behind a glove's packet may stand the reply to a command.
        return [_edited(units[0], edits), *units[1:]]
    reports = ReportReassembler()
    messages = [m for m in map(reports.feed, units) if m is not None]
    if len(messages) != 1:
        raise InvalidInputError(f"mock fault: got {len(units)} reports, expected one whole packet")
    report_id, data = messages[0]
    counter = REPORT_HEADER.unpack_from(units[0])[1]
    return split_into_reports(report_id, counter, _edited(data, edits))


def halve_units(units: Sequence[bytes]) -> list[bytes]:
    """The first half of a packet's bytes, or of its reports."""
    if len(units) > 1:
        return list(units[: len(units) // 2])
    whole = units[0]
    return [whole[: len(whole) // 2]]


def family_of(units: Sequence[bytes]) -> bytes:
    """What kind of packet the units are: our magic, or the mark of another family."""
    first = units[0][REPORT_HEADER.size :] if _is_report(units[0]) else units[0]
    if first.startswith(OUR_MAGIC):
        return first[:MAGIC_SIZE]
    return MARK if first.startswith(MARK) else TAIL


def is_marked_when_nan(family: bytes) -> bool:
    """Whether a driver records a NaN as a missing part of a sample, and refuses no packet."""
    return family in {FINGER_MAGIC, MARK}


def other_version(data: bytes) -> bytes:
    """The packet of a device with newer firmware."""
    return _edit_ours(data, lambda _, packet: _with(packet, version=VERSION + 1), "a version")


def other_side(data: bytes) -> bytes:
    """The packet of the other hand's device."""
    if family_of([data]) == MARK:
        return _edit_wuji(data, lambda hand, cells: (1 - hand, cells))
    return _edit_ours(
        data,
        lambda _, p: _with(p, source=OTHER_SIDE.get(p.source, SOURCES["left"])),
        "a hand",
    )


def pin_taxels(cells: Sequence[int], how: Literal["stuck", "saturated"]) -> Edit:
    """Raw cells of a glove that show the same whatever presses them."""
    return partial(_pin, cells=list(cells), shown=PINNED[how])


def put_nan(data: bytes) -> bytes:
    """The first number that is one is none."""
    family = family_of([data])
    if family == MARK:
        return _edit_wuji(data, lambda hand, cells: (hand, _without_first(cells)))
    if family == TAIL:
        return _without_first(np.frombuffer(data[: -len(TAIL)], "<f4")).tobytes() + TAIL

    def change(magic: bytes, packet: Packet) -> Packet:
        if magic not in FLOATS:
            raise InvalidInputError(f"mock fault: a {magic!r} packet has no number that can be NaN")
        start, dtype = FLOATS[magic]
        values = _without_first(np.frombuffer(packet.payload, dtype=dtype, offset=start))
        return _with(packet, payload=packet.payload[:start] + values.tobytes())

    return _edit_ours(data, change, "a number")


def _is_report(unit: bytes) -> bool:
    return len(unit) == REPORT_BYTES and not unit.startswith((OUR_MAGIC, MARK))


def _edited(data: bytes, edits: Sequence[Edit]) -> bytes:
    for edit in edits:
        data = edit(data)
    return data


def _pin(data: bytes, *, cells: list[int], shown: dict[bytes, float]) -> bytes:
    family = family_of([data])
    if family not in shown:
        raise InvalidInputError(f"mock fault: pinned taxels on a {family!r}, expected a glove")

    def pinned(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[cells] = shown[family]
        return values

    if family == MARK:
        return _edit_wuji(data, lambda hand, grid: (hand, pinned(grid)))
    if family == TAIL:
        return pinned(np.frombuffer(data[: -len(TAIL)], "<f4")).tobytes() + TAIL
    return _edit_ours(
        data,
        lambda _, p: _with(p, payload=pinned(np.frombuffer(p.payload, "<u2")).tobytes()),
        "a taxel",
    )


def _with(
    packet: Packet,
    *,
    version: int | None = None,
    source: int | None = None,
    payload: bytes | None = None,
) -> Packet:
    return Packet(
        packet.version if version is None else version,
        packet.source if source is None else source,
        packet.sequence,
        packet.t_device_ns,
        packet.payload if payload is None else payload,
    )


def _without_first(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values[np.flatnonzero(np.isfinite(values))[0]] = np.nan
    return values


def _edit_ours(data: bytes, change: Callable[[bytes, Packet], Packet], word: str) -> bytes:
    magic = data[:MAGIC_SIZE]
    if not magic.startswith(OUR_MAGIC):
        raise InvalidInputError(f"mock fault: packets of this family do not tell {word}")
    _, version, source, length, sequence, t_device_ns = HEADER.unpack_from(data)
    payload = data[HEADER.size : len(data) - CRC.size]
    packet = Packet(version, source, sequence, t_device_ns, payload[:length])
    return encode_packet(magic, change(magic, packet))


def _edit_wuji(data: bytes, change: Callable[[int, np.ndarray], tuple[int, np.ndarray]]) -> bytes:
    hand = HEAD.unpack_from(data)[2]
    hand, cells = change(hand, np.frombuffer(data, "<f4", NUM_CELLS, HEAD.size))
    packet = bytearray(data)
    HEAD.pack_into(packet, 0, MARK, PACKET_BYTES, hand)
    packet[HEAD.size : HEAD.size + cells.nbytes] = cells.tobytes()
    WUJI_CRC.pack_into(packet, CRC_OFFSET, crc16(bytes(packet[len(MARK) : CRC_OFFSET])))
    return bytes(packet)
