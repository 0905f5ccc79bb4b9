"""Data packets of the Wuji tactile glove: 24 × 32 cells in parts of full scale, CRC-16."""

import math
import struct
from typing import Literal, NamedTuple

import fastcrc
import numpy as np
from jaxtyping import Float32

from dextouch.errors import DeviceError, InvalidInputError
from dextouch.streams import ClockCapabilities, Sample
from dextouch.tactile.layout import Side, TactileLayout
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import DeviceKind, GloveSettings, serial_transport
from services.acquisition.drivers import base
from services.acquisition.drivers.packets import FrameSearch

MARK = b"\xaa\x55"
PACKET_BYTES = 3088
GRID = (24, 32)
NUM_CELLS = GRID[0] * GRID[1]
# Unit and largest value of the cells.
UNIT = "full_scale"
FULL_SCALE = 1.0
# mark, length of the whole packet, hand, three bytes that say nothing
HEAD = struct.Struct("<2sHB3x")
# after the cells: sequence, milliseconds since the device started
STAMPS = struct.Struct("<HI")
CRC = struct.Struct("<H")
CRC_OFFSET = PACKET_BYTES - CRC.size
HANDS: dict[int, Side] = {0: "left", 1: "right"}
SEQUENCE_BITS = 16
TIME_BITS = 32
TICK_NS = 1_000_000
NOMINAL_RATE_HZ = 120.0
_CELL = np.dtype("<f4")


class WujiPacket(NamedTuple):
    """One packet whose checksum and range held."""

    hand: int
    sequence: int
    time_ms: int
    cells: Float32[np.ndarray, "768"]


class WujiFrames(FrameSearch[WujiPacket]):
    """Finds the packets: CRC-16 (polynomial 0x1021, start 0xFFFF), then the range of the cells.

    Sixteen bits let one damaged packet of 65 536 pass, so numbers that are no pressures are held
    back beyond it and counted as suspects.
    """

    def __init__(self) -> None:
        super().__init__(MARK, sequence_bits=SEQUENCE_BITS)
        self._last_ms: int | None = None

    def _take(self, data: bytes, position: int) -> tuple[WujiPacket, int] | None:
        if len(data) < position + HEAD.size:
            self._needed = position + HEAD.size
            return None
        _, length, hand = HEAD.unpack_from(data, position)
        if length != PACKET_BYTES:
            self.statistics.length_errors += 1
            return None
        if len(data) < position + PACKET_BYTES:
            self._needed = position + PACKET_BYTES
            return None
        # Bytes of its own (no copy if it came alone), in which the cells lie at a multiple of their
        # size.
        packet = data[position : position + PACKET_BYTES]
        if CRC.unpack_from(packet, CRC_OFFSET)[0] != crc16(packet[len(MARK) : CRC_OFFSET]):
            self.statistics.crc_errors += 1
            return None
        cells = np.frombuffer(packet, _CELL, NUM_CELLS, HEAD.size)
        if not are_pressures(cells):
            self.statistics.suspects += 1
            return None
        sequence, time_ms = STAMPS.unpack_from(packet, CRC_OFFSET - STAMPS.size)
        self.sequence.count(
            sequence, t_device_ns=time_ms * TICK_NS, is_restarted=self._went_back(time_ms)
        )
        return WujiPacket(hand, sequence, time_ms, cells), PACKET_BYTES

    def _went_back(self, time_ms: int) -> bool:
        """Whether the device's clock was restarted; running over 2³² ms is none."""
        last_ms, self._last_ms = self._last_ms, time_ms
        return last_ms is not None and (time_ms - last_ms) % (1 << TIME_BITS) >= 1 << TIME_BITS - 1


class WujiGloveDecoder(base.StreamDecoder[WujiPacket]):
    """Decodes one glove's byte stream to float32 [768] of full scale, 0 … 1, row by row.

    Cells that the glove has not are NaN, as it sends them. Without a `layout` only the calibration
    maps them to the taxels of `dextouch_v1`.
    """

    cells = base.CellLayout(FULL_SCALE, GRID)

    def __init__(
        self, side: Side, *, label: str | None = None, layout: TactileLayout | None = None
    ) -> None:
        if layout is not None:
            _check_layout(layout, device=f"glove_{side}")
        descriptor = base.glove_stream(
            side,
            label,
            shape=(NUM_CELLS,),
            dtype="float32",
            unit=UNIT,
            layout=layout,
            nominal_rate_hz=NOMINAL_RATE_HZ,
            capabilities=ClockCapabilities(
                crc=True,
                sequence=True,
                sequence_bits=SEQUENCE_BITS,
                device_time=True,
                tick_ns=TICK_NS,
                device_time_bits=TIME_BITS,
            ),
        )
        super().__init__(descriptor, WujiFrames())
        self._side = side

    def _sample(self, packet: WujiPacket, t_host_ns: int) -> Sample:
        side = HANDS.get(packet.hand)
        if side != self._side:
            raise DeviceError(
                f"glove_{self._side}: says it is hand {packet.hand} ({side!r}), expected "
                f"{self._side!r}; are left and right swapped?",
                event="wrong_side",
            )
        return Sample(t_host_ns, packet.cells, packet.time_ms * TICK_NS, packet.sequence)


def _check_layout(layout: TactileLayout, *, device: str) -> None:
    """Refuse a layout by whose cells, unit or full scale conversion would make wrong pressures."""
    base.check_raw_cells(layout, NUM_CELLS, device=device)
    if (layout.unit, layout.full_scale) != (UNIT, FULL_SCALE):
        raise InvalidInputError(
            f"{device}: got layout {layout.name!r} with unit {layout.unit!r} and full_scale "
            f"{layout.full_scale:g}, expected {UNIT!r} and {FULL_SCALE:g}, since this glove sends "
            "shares 0 … 1 of full scale; the pressure at full scale goes to kpa_per_unit"
        )


def crc16(data: bytes) -> int:
    """CRC-16-CCITT: polynomial 0x1021, start 0xFFFF, most significant bit first."""
    return fastcrc.crc16.ibm_3740(data)


def are_pressures(cells: Float32[np.ndarray, " n"]) -> bool:
    """Whether every number is within 0 … 1 or NaN."""
    # These two pass over NaN unless there is nothing else.
    low, high = float(np.fmin.reduce(cells)), float(np.fmax.reduce(cells))
    return (low >= 0.0 and high <= 1.0) or math.isnan(low)


class WujiGloveSettings(GloveSettings):
    """A Wuji glove on a serial line; its packets contain the hand."""

    kind: Literal["wuji_glove"] = "wuji_glove"


def build(settings: WujiGloveSettings, clock: StationClock) -> base.Driver:
    """The driver of one glove."""
    transport = serial_transport(settings, device=settings.device)
    layout = settings.read_layout()
    decoder = WujiGloveDecoder(settings.side, label=settings.label, layout=layout)
    return base.Driver(settings.device, transport=transport, decoder=decoder, clock=clock)


KIND = DeviceKind(
    name="wuji_glove",
    settings=WujiGloveSettings,
    build=build,
    mock="services.acquisition.mocks.gloves:mock_wuji_glove",
)
