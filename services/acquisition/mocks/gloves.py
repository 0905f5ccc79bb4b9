"""Simulated gloves: our own, which answers commands, a Wuji glove, and one of bare float32s."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from dextouch.errors import ShapeError
from dextouch.schemas import Matrix, matrix_rows
from dextouch.streams import StreamDescriptor
from dextouch.tactile.layout import DEXTOUCH_V1, NUM_TAXELS, Side, TactileLayout, split_pads
from services.acquisition.clock import StationClock
from services.acquisition.devices import tactile_glove, wuji_glove
from services.acquisition.devices.justfloat_glove import TAIL, JustFloatGloveDecoder
from services.acquisition.drivers.packets import (
    SOURCES,
    VERSION,
    Packet,
    PacketDecoder,
    encode_packet,
)
from services.acquisition.mocks import replay
from services.acquisition.mocks.faults import (
    DeviceFaults,
    OurPacketEdits,
    PacketEdits,
    PacketFields,
)
from services.acquisition.mocks.ports import PtyPort

FIRMWARE = (1, 0, 0)
OFFSET_COUNTS = 120.0
GAIN_COUNTS_PER_KPA = 40.0
OFFSET_SPREAD_COUNTS = 10.0
GAIN_SPREAD = 0.05
# Of a glove of another layout, whose counts may be few: 1 % of full scale.
OFFSET_SHARE = 0.01
COUNTS_PER_KPA = 40.0
NUM_VALUES = 401
FULL_SCALE = 4095.0
FULL_SCALE_KPA = 100.0
# Which cells the real glove has is not public: the mock's grid is its own choice.
_FINGER_ROWS = slice(0, 4)
_PALM_ROWS, _PALM_COLUMNS = slice(6, 21), slice(8, 24)


class GloveAnswers:
    """Replies of a mock glove to the requests of the host."""

    def __init__(
        self, side: Side, *, serial_number: str, device_time_ns: Callable[[], int]
    ) -> None:
        self._side: Side = side
        self._identity = tactile_glove.encode_identity(serial_number, FIRMWARE)
        self._device_time_ns = device_time_ns
        # Requests are no sequence: a driver that was started anew counts from 1 again.
        sizes = (tactile_glove.REQUEST.size, tactile_glove.REQUEST.size)
        self._requests = PacketDecoder(
            tactile_glove.MAGIC,
            min_payload=0,
            max_payload=0,
            others={tactile_glove.COMMAND_MAGIC: sizes},
        )

    def answer(self, data: bytes) -> list[bytes]:
        """Replies to the requests that `data` completes."""
        t_received_ns = self._device_time_ns()
        return [self._reply(packet, t_received_ns) for packet in self._requests.feed(data)]

    def _reply(self, packet: Packet, t_received_ns: int) -> bytes:
        bodies = {
            tactile_glove.Command.IDENTIFY: self._identity,
            tactile_glove.Command.TIME_SYNC: tactile_glove.TIME_SYNC.pack(t_received_ns),
        }
        body = bodies.get(tactile_glove.REQUEST.unpack(packet.payload)[0])
        status = tactile_glove.Status.UNKNOWN_COMMAND if body is None else tactile_glove.Status.OK
        source, t_device_ns = SOURCES[self._side], self._device_time_ns()
        return tactile_glove.encode_reply(
            packet, status, body or b"", source=source, t_device_ns=t_device_ns
        )


@dataclass(frozen=True)
class GloveCalibration:
    """counts = tare + gain · pressure, cell by cell in raw scan order."""

    tare_counts: Float64[np.ndarray, " cells"]
    gain_counts_per_kpa: Float64[np.ndarray, " cells"]
    layout: TactileLayout = DEXTOUCH_V1

    @staticmethod
    def seeded(side: Side, seed: int, layout: TactileLayout = DEXTOUCH_V1) -> "GloveCalibration":
        """A glove as it comes from the factory: no two cells alike."""
        rng = replay.device_rng(seed, f"calibration_{side}")
        spread = rng.uniform(-1.0, 1.0, (2, layout.num_raw_cells))
        offset, offset_spread, gain = OFFSET_COUNTS, OFFSET_SPREAD_COUNTS, GAIN_COUNTS_PER_KPA
        if layout != DEXTOUCH_V1:
            offset = OFFSET_SHARE * layout.full_scale
            offset_spread = offset / 10
            gain = layout.full_scale / layout.range_kpa
        return GloveCalibration(
            offset + offset_spread * spread[0], gain * (1.0 + GAIN_SPREAD * spread[1]), layout
        )

    @staticmethod
    def nominal(side: Side, layout: TactileLayout) -> "GloveCalibration":
        """A glove whose readings have the unit and scale of its layout, and no offset."""
        kpa_per_unit = layout.nominal_kpa_per_unit
        if kpa_per_unit is None:
            kpa_per_unit = np.full(layout.num_taxels, layout.range_kpa / layout.full_scale)
        gain = np.ones(layout.num_raw_cells)
        gain[layout.raw_indices(side)] = 1.0 / kpa_per_unit
        return GloveCalibration(np.zeros(layout.num_raw_cells), gain, layout)

    def matrices(self, side: Side) -> dict[str, Matrix]:
        """Calibration matrices of this glove."""
        return {
            f"tactile_{side}_tare_counts": matrix_rows(self.tare_counts[None]),
            f"tactile_{side}_gain_counts_per_kpa": matrix_rows(self.gain_counts_per_kpa[None]),
        }

    def readings(self, taxels_kpa: np.ndarray, *, side: Side) -> Float64[np.ndarray, "... cells"]:
        """Raw readings of pressures [..., taxels]; clipped at full scale."""
        raw_kpa = self.layout.expand(np.asarray(taxels_kpa, dtype=np.float64), side=side)
        readings = self.tare_counts + self.gain_counts_per_kpa * raw_kpa
        return np.clip(readings, 0, self.layout.full_scale)

    def counts(self, taxels_kpa: np.ndarray, *, side: Side) -> np.ndarray:
        """The same as whole counts (uint16)."""
        return np.rint(self.readings(taxels_kpa, side=side)).astype("<u2")


def mock_glove(
    slot: replay.MockSlot,
    *,
    calibration: GloveCalibration | None = None,
    worn_side: Side | None = None,
) -> replay.MockPair:
    """Our own glove, which answers commands; its serial number is the name of its slot.

    Without a calibration one is made from the seed; `worn_side` is the hand that it says it is, if
    that is the wrong one.
    """
    name, side = slot.name, slot.side
    unit_seed = slot.seed if slot.unit_seed is None else slot.unit_seed
    layout = slot.stream.descriptor.layout
    glove = calibration or GloveCalibration.seeded(side, unit_seed, layout or DEXTOUCH_V1)
    worn: Side = worn_side or side
    source = TactileGloveSource(slot.stream, side=worn, calibration=glove, faults=slot.faults)
    # The device is made of its port, and tells its time to what answers there.
    answers = GloveAnswers(
        worn, serial_number=name, device_time_ns=lambda: _device_time_ns(device, slot.clock)
    )
    port = PtyPort(name, answer=answers.answer)
    device = replay.MockDevice(slot, source, port)
    driver = tactile_glove.TactileGlove(
        side, transport=port.transport, clock=slot.clock, serial_number=name, layout=layout
    )
    return replay.MockPair(device, driver, glove.matrices(side))


class TactileGloveSource(replay.PacketSource):
    """Packets of one glove, of a stream float32 [n, taxels] in kPa.

    Dead and drifted raw cells of the faults are planted.
    """

    edits = OurPacketEdits({"stuck": 1_000.0, "saturated": float(tactile_glove.FULL_SCALE_COUNTS)})

    def __init__(
        self,
        stream: replay.ReplayStream,
        *,
        side: Side,
        calibration: GloveCalibration,
        faults: DeviceFaults | None = None,
    ) -> None:
        num_taxels = calibration.layout.num_taxels
        if stream.descriptor.shape != (num_taxels,):
            raise ShapeError(
                f"{stream.descriptor.name}: got {stream.descriptor.shape}, expected ({num_taxels},)"
            )
        self.t_ns = stream.t_ns
        self._side = side
        self._counts = calibration.counts(stream.values, side=side)
        faults = faults or DeviceFaults()
        drifted = list(faults.drifted_taxels)
        moved = self._counts[:, drifted].astype(np.int64) + faults.drift_counts
        self._counts[:, drifted] = np.clip(moved, 0, tactile_glove.FULL_SCALE_COUNTS)
        self._counts[:, list(faults.dead_taxels)] = 0

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        counts = self._counts[index]
        packet = Packet(VERSION, SOURCES[self._side], sequence, t_device_ns, counts.tobytes())
        return [encode_packet(tactile_glove.MAGIC, packet)]


def _device_time_ns(device: replay.MockDevice, clock: StationClock) -> int:
    """Time of a mock device's clock, from its last packet; any origin before the first."""
    ledger, now_ns = device.ledger, clock.now_ns()
    if not ledger.t_device_ns:
        return now_ns
    # The ledger is written by the player's thread: a column may be one row ahead.
    last = len(ledger.flipped_bits) - 1
    since_ns = now_ns - ledger.t_true_ns[last]
    skew_ns = round(since_ns * device.faults.skew_ppm * 1e-6)
    return ledger.t_device_ns[last] + since_ns + skew_ns


def mock_justfloat_glove(slot: replay.MockSlot) -> replay.MockPair:
    """A glove that sends bare float32s at the rate of the stream, in the unit of its layout."""
    source = JustFloatGloveSource(slot.stream, side=slot.side, dead_taxels=slot.faults.dead_taxels)
    layout = slot.stream.descriptor.layout
    decoder = JustFloatGloveDecoder(
        slot.side,
        num_values=NUM_VALUES if layout is None else layout.num_raw_cells,
        full_scale=FULL_SCALE if layout is None else layout.full_scale,
        rate_hz=slot.stream.descriptor.nominal_rate_hz,
        layout=layout,
    )
    return replay.serial_mock(
        slot, source=source, decoder=decoder, calibration=_nominal_zero(decoder.descriptors[0])
    )


def _nominal_zero(descriptor: StreamDescriptor) -> dict[str, Matrix]:
    """Tare of a glove of a known layout, whose mock rests at zero; its gain follows from the unit.

    Where the unit does not say it, the gain is that of `GloveCalibration.nominal`.
    """
    layout, side = descriptor.layout, descriptor.side
    if layout is None or side is None:
        return {}
    known = GloveCalibration.nominal(side, layout).matrices(side)
    if layout.nominal_kpa_per_unit is not None:
        del known[f"tactile_{side}_gain_counts_per_kpa"]
    return known


class JustFloatPacketEdits(PacketEdits):
    """Faults inside a packet that contains only numbers, without hand and version."""

    def fields(self, data: bytes) -> PacketFields:
        """All numbers."""
        return PacketFields(np.frombuffer(data[: -len(TAIL)], "<f4").copy())

    def packed(self, data: bytes, fields: PacketFields) -> bytes:
        """A packet of these numbers."""
        return data if fields.numbers is None else encode_justfloat(fields.numbers)


class JustFloatGloveSource(replay.PacketSource):
    """Packets of one glove: the taxels' counts, then zeros in the slots that mean nothing.

    With a layout, for which the side is needed, they are readings in its unit and in the order of
    its raw cells. `stream` is float32 [n, taxels] in kPa; `dead_taxels` of the packet read zero.
    """

    edits = JustFloatPacketEdits({"stuck": 1_000.0, "saturated": FULL_SCALE})

    def __init__(
        self, stream: replay.ReplayStream, *, side: Side = "left", dead_taxels: Sequence[int] = ()
    ) -> None:
        self.t_ns, layout = stream.t_ns, stream.descriptor.layout
        if layout is not None:
            glove = GloveCalibration.nominal(side, layout)
            self._values = glove.readings(stream.values, side=side).astype("<f4")
            self._values[:, list(dead_taxels)] = 0.0
            return
        # No device sends the negative zero that rounding leaves of noise.
        counts = np.clip(np.rint(COUNTS_PER_KPA * stream.values), 0.0, FULL_SCALE) + 0.0
        self._values = np.zeros((len(counts), NUM_VALUES), dtype="<f4")
        self._values[:, :NUM_TAXELS] = counts
        self._values[:, list(dead_taxels)] = 0.0

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet; the device sends neither sequence number nor time."""
        return [encode_justfloat(self._values[index])]


def encode_justfloat(values: Float32[np.ndarray, " n"]) -> bytes:
    """Bytes of one packet."""
    return values.astype("<f4").tobytes() + TAIL


def mock_wuji_glove(slot: replay.MockSlot) -> replay.MockPair:
    """A Wuji glove: CRC-16, a number of 16 bits, milliseconds."""
    source = WujiGloveSource(
        replay.at_rate(slot.stream, wuji_glove.NOMINAL_RATE_HZ),
        side=slot.side,
        dead_taxels=slot.faults.dead_taxels,
    )
    decoder = wuji_glove.WujiGloveDecoder(slot.side, layout=slot.stream.descriptor.layout)
    return replay.serial_mock(
        slot, source=source, decoder=decoder, calibration=_nominal_zero(decoder.descriptors[0])
    )


class WujiPacketEdits(PacketEdits):
    """Faults inside a Wuji glove's packet, which tells its hand and no version."""

    # A cell may be NaN.
    marks_nan = True

    def fields(self, data: bytes) -> PacketFields:
        """Hand and cells of the grid, row by row."""
        cells = np.frombuffer(data, "<f4", wuji_glove.NUM_CELLS, wuji_glove.HEAD.size).copy()
        return PacketFields(cells, wuji_glove.HANDS[wuji_glove.HEAD.unpack_from(data)[2]])

    def packed(self, data: bytes, fields: PacketFields) -> bytes:
        """A packet of these cells and this hand."""
        sequence, time_ms = wuji_glove.STAMPS.unpack_from(
            data, wuji_glove.CRC_OFFSET - wuji_glove.STAMPS.size
        )
        hand = 0 if fields.side == "left" else 1
        return encode_wuji(hand, sequence, time_ms, np.asarray(fields.numbers).tobytes())


class WujiGloveSource(replay.PacketSource):
    """Packets of one glove, of a stream float32 [n, taxels] in kPa.

    `dead_taxels` are cells of the grid, row by row, that read zero.
    """

    edits = WujiPacketEdits({"stuck": 0.25, "saturated": 1.0})

    def __init__(
        self, stream: replay.ReplayStream, *, side: Side, dead_taxels: Sequence[int] = ()
    ) -> None:
        self.t_ns = stream.t_ns
        self._hand = {name: number for number, name in wuji_glove.HANDS.items()}[side]
        layout = stream.descriptor.layout
        if layout is None:
            shares = np.clip(stream.values / FULL_SCALE_KPA, 0.0, 1.0).astype(np.float32)
            self._cells = grid_of(shares)
        else:
            glove = GloveCalibration.nominal(side, layout)
            there = layout.expand(np.ones(layout.num_taxels, dtype=np.bool_), side=side)
            readings = glove.readings(stream.values, side=side)
            self._cells = np.where(there, readings, np.nan).astype("<f4")
        self._cells.reshape(len(self._cells), -1)[:, list(dead_taxels)] = 0.0

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet; sequence and milliseconds run over as the device's do."""
        cells = self._cells[index].tobytes()
        return [encode_wuji(self._hand, sequence, t_device_ns // wuji_glove.TICK_NS, cells)]


def grid_of(taxels: Float32[np.ndarray, "n taxels"]) -> Float32[np.ndarray, "n 24 32"]:
    """Fingertips in the top rows, the palm below, NaN where the glove has no cell."""
    grid = np.full((len(taxels), *wuji_glove.GRID), np.nan, dtype="<f4")
    fingertips, palm = split_pads(taxels.reshape(-1, NUM_TAXELS))
    for finger in range(5):
        columns = slice(1 + 6 * finger, 5 + 6 * finger)
        grid[:, _FINGER_ROWS, columns] = fingertips[:, finger]
    grid[:, _PALM_ROWS, _PALM_COLUMNS] = palm
    return grid


def encode_wuji(hand: int, sequence: int, time_ms: int, cells: bytes) -> bytes:
    """Bytes of one packet; `cells` are 768 float32s."""
    packet = wuji_glove.HEAD.pack(wuji_glove.MARK, wuji_glove.PACKET_BYTES, hand) + cells
    packet += wuji_glove.STAMPS.pack(
        sequence % (1 << wuji_glove.SEQUENCE_BITS), time_ms % (1 << wuji_glove.TIME_BITS)
    )
    return packet + wuji_glove.CRC.pack(wuji_glove.crc16(packet[len(wuji_glove.MARK) :]))
