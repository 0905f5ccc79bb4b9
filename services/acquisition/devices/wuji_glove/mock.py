"""A simulated Wuji glove: its packets, with pressures on a chosen grid."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from dextouch.tactile.layout import NUM_TAXELS, Side, split_pads
from services.acquisition.devices.wuji_glove.driver import (
    CRC,
    CRC_OFFSET,
    GRID,
    HANDS,
    HEAD,
    MARK,
    NOMINAL_RATE_HZ,
    NUM_CELLS,
    PACKET_BYTES,
    SEQUENCE_BITS,
    STAMPS,
    TICK_NS,
    TIME_BITS,
    WujiGloveDecoder,
    crc16,
)
from services.acquisition.mocks.faults import PacketEdits, PacketFields, Pinned
from services.acquisition.mocks.replay import (
    MockPair,
    MockSlot,
    PacketSource,
    ReplayStream,
    at_rate,
    serial_mock,
)

FULL_SCALE_KPA = 100.0
# What pinned cells show, in parts of full scale.
PINNED: dict[Pinned, float] = {"stuck": 0.25, "saturated": 1.0}
# Which cells the real glove has is not public: the mock's grid is its own choice.
_FINGER_ROWS = slice(0, 4)
_PALM_ROWS, _PALM_COLUMNS = slice(6, 21), slice(8, 24)


def mock_wuji_glove(place: MockSlot) -> MockPair:
    """A Wuji glove: CRC-16, a number of 16 bits, milliseconds."""
    source = WujiGloveSource(
        at_rate(place.stream, NOMINAL_RATE_HZ),
        side=place.side,
        dead_taxels=place.faults.dead_taxels,
    )
    return serial_mock(place, source=source, decoder=WujiGloveDecoder(place.side))


class WujiPacketEdits(PacketEdits):
    """Faults inside a Wuji glove's packet, which tells its hand and no version."""

    # A cell may be NaN.
    marks_nan = True

    def fields(self, data: bytes) -> PacketFields:
        """Hand and cells of the grid, row by row."""
        cells = np.frombuffer(data, "<f4", NUM_CELLS, HEAD.size).copy()
        return PacketFields(cells, HANDS[HEAD.unpack_from(data)[2]])

    def packed(self, data: bytes, fields: PacketFields) -> bytes:
        """A packet of these cells and this hand."""
        sequence, time_ms = STAMPS.unpack_from(data, CRC_OFFSET - STAMPS.size)
        hand = 0 if fields.side == "left" else 1
        return encode_wuji(hand, sequence, time_ms, np.asarray(fields.numbers).tobytes())


class WujiGloveSource(PacketSource):
    """Packets of one glove.

    Args:
        stream: float32 [n, 320] in kPa.
        side: which hand.
        dead_taxels: cells of the grid, row by row, that read zero.
    """

    edits = WujiPacketEdits(PINNED)

    def __init__(
        self,
        stream: ReplayStream,
        *,
        side: Side,
        dead_taxels: Sequence[int] = (),
    ) -> None:
        self.t_ns = stream.t_ns
        self._hand = {name: number for number, name in HANDS.items()}[side]
        self._cells = grid_of(np.clip(stream.values / FULL_SCALE_KPA, 0.0, 1.0).astype(np.float32))
        self._cells.reshape(len(self._cells), -1)[:, list(dead_taxels)] = 0.0

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet; sequence and milliseconds run over as the device's do."""
        cells = self._cells[index].tobytes()
        return [encode_wuji(self._hand, sequence, t_device_ns // TICK_NS, cells)]


def grid_of(taxels: Float32[np.ndarray, "n 320"]) -> Float32[np.ndarray, "n 24 32"]:
    """Fingertips in the top rows, the palm below, NaN where the glove has no cell."""
    grid = np.full((len(taxels), *GRID), np.nan, dtype="<f4")
    fingertips, palm = split_pads(taxels.reshape(-1, NUM_TAXELS))
    for finger in range(5):
        columns = slice(1 + 6 * finger, 5 + 6 * finger)
        grid[:, _FINGER_ROWS, columns] = fingertips[:, finger]
    grid[:, _PALM_ROWS, _PALM_COLUMNS] = palm
    return grid


def encode_wuji(hand: int, sequence: int, time_ms: int, cells: bytes) -> bytes:
    """Bytes of one packet; `cells` are 768 float32s."""
    packet = HEAD.pack(MARK, PACKET_BYTES, hand) + cells
    packet += STAMPS.pack(sequence % (1 << SEQUENCE_BITS), time_ms % (1 << TIME_BITS))
    return packet + CRC.pack(crc16(packet[len(MARK) :]))
