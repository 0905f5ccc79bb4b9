"""Pressures of one hand come in; a Wuji glove's data packets go out."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int64

from dextouch.tactile.layout import NUM_TAXELS, Side, split_pads
from services.acquisition.drivers.glove_wuji import (
    CRC,
    GRID,
    HANDS,
    HEAD,
    MARK,
    PACKET_BYTES,
    SEQUENCE_BITS,
    STAMPS,
    TICK_NS,
    TIME_BITS,
    crc16,
)
from services.acquisition.mocks.replay import ReplayStream

FULL_SCALE_KPA = 100.0
# Which cells the real glove has is not public: the mock's grid is its own choice.
_FINGER_ROWS = slice(0, 4)
_PALM_ROWS, _PALM_COLUMNS = slice(6, 21), slice(8, 24)


class WujiGloveSource:
    """Packets of one glove.

    Args:
        stream: float32 [n, 320] in kPa.
        side: which hand.
        scale_kpa: the pressure that reads 1.
        dead_taxels: cells of the grid, row by row, that read zero.
    """

    def __init__(
        self,
        stream: ReplayStream,
        *,
        side: Side,
        scale_kpa: float = FULL_SCALE_KPA,
        dead_taxels: Sequence[int] = (),
    ) -> None:
        self._stream = stream
        self._hand = {name: number for number, name in HANDS.items()}[side]
        self._cells = grid_of(np.clip(stream.values / scale_kpa, 0.0, 1.0).astype(np.float32))
        self._cells.reshape(len(self._cells), -1)[:, list(dead_taxels)] = 0.0

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        return self._stream.t_ns

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
