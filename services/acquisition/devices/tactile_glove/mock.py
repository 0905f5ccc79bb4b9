"""Simulated glove of our own protocol, with its own offsets and gains, that answers requests."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import ShapeError
from dextouch.schemas import Matrix, matrix_rows
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS, Side, expand_taxels
from services.acquisition.clock import StationClock
from services.acquisition.devices.tactile_glove.driver import (
    COMMAND_MAGIC,
    FULL_SCALE_COUNTS,
    MAGIC,
    REQUEST,
    TIME_SYNC,
    Command,
    Status,
    TactileGlove,
    encode_identity,
    encode_reply,
)
from services.acquisition.drivers.packets import (
    SOURCES,
    VERSION,
    Packet,
    PacketDecoder,
    encode_packet,
)
from services.acquisition.mocks.faults import DeviceFaults, OurPacketEdits, Pinned
from services.acquisition.mocks.ports import PtyPort
from services.acquisition.mocks.replay import (
    MockDevice,
    MockPair,
    MockSlot,
    PacketSource,
    ReplayStream,
    device_rng,
)

FIRMWARE = (1, 0, 0)
OFFSET_COUNTS = 120.0
GAIN_COUNTS_PER_KPA = 40.0
OFFSET_SPREAD_COUNTS = 10.0
GAIN_SPREAD = 0.05
# What pinned cells show.
PINNED: dict[Pinned, float] = {"stuck": 1_000.0, "saturated": float(FULL_SCALE_COUNTS)}


class GloveAnswers:
    """Replies of a mock glove to the requests of the host.

    Args:
        side: which hand it says it is.
        serial_number: that it says it has.
        device_time_ns: gives what the glove's clock shows now.
    """

    def __init__(
        self, side: Side, *, serial_number: str, device_time_ns: Callable[[], int]
    ) -> None:
        self._side: Side = side
        self._identity = encode_identity(serial_number, FIRMWARE)
        self._device_time_ns = device_time_ns
        # Requests are no sequence: a driver that was started anew counts from 1 again.
        sizes = (REQUEST.size, REQUEST.size)
        self._requests = PacketDecoder(
            MAGIC, min_payload=0, max_payload=0, others={COMMAND_MAGIC: sizes}
        )

    def answer(self, data: bytes) -> list[bytes]:
        """Replies to the requests that `data` completes."""
        t_received_ns = self._device_time_ns()
        return [self._reply(packet, t_received_ns) for packet in self._requests.feed(data)]

    def _reply(self, packet: Packet, t_received_ns: int) -> bytes:
        bodies = {
            Command.IDENTIFY: self._identity,
            Command.TIME_SYNC: TIME_SYNC.pack(t_received_ns),
        }
        body = bodies.get(REQUEST.unpack(packet.payload)[0])
        status = Status.UNKNOWN_COMMAND if body is None else Status.OK
        source, t_device_ns = SOURCES[self._side], self._device_time_ns()
        return encode_reply(packet, status, body or b"", source=source, t_device_ns=t_device_ns)


@dataclass(frozen=True)
class GloveCalibration:
    """counts = tare + gain · pressure, cell by cell in raw scan order."""

    tare_counts: Float64[np.ndarray, "360"]
    gain_counts_per_kpa: Float64[np.ndarray, "360"]

    @staticmethod
    def seeded(side: Side, seed: int) -> "GloveCalibration":
        """A glove as it comes from the factory: no two cells alike."""
        rng = device_rng(seed, f"calibration_{side}")
        spread = rng.uniform(-1.0, 1.0, (2, NUM_RAW_TAXELS))
        return GloveCalibration(
            OFFSET_COUNTS + OFFSET_SPREAD_COUNTS * spread[0],
            GAIN_COUNTS_PER_KPA * (1.0 + GAIN_SPREAD * spread[1]),
        )

    def matrices(self, side: Side) -> dict[str, Matrix]:
        """Calibration matrices of this glove."""
        return {
            f"tactile_{side}_tare_counts": matrix_rows(self.tare_counts[None]),
            f"tactile_{side}_gain_counts_per_kpa": matrix_rows(self.gain_counts_per_kpa[None]),
        }

    def counts(self, taxels_kpa: np.ndarray, *, side: Side) -> np.ndarray:
        """Raw counts (uint16 [..., 360]) of pressures [..., 320]; clipped at full scale."""
        raw_kpa = expand_taxels(np.asarray(taxels_kpa, dtype=np.float64), side=side)
        counts = np.rint(self.tare_counts + self.gain_counts_per_kpa * raw_kpa)
        return np.clip(counts, 0, FULL_SCALE_COUNTS).astype("<u2")


def mock_glove(
    place: MockSlot,
    *,
    calibration: GloveCalibration | None = None,
    worn_side: Side | None = None,
) -> MockPair:
    """Our own glove, which answers commands.

    Args:
        place: where it stands; its serial number is its name.
        calibration: of this glove; made from the seed if None.
        worn_side: which hand it says it is, if it is the wrong one.
    """
    name, side = place.name, place.side
    unit_seed = place.seed if place.unit_seed is None else place.unit_seed
    glove = calibration or GloveCalibration.seeded(side, unit_seed)
    told: Side = worn_side or side
    source = TactileGloveSource(
        place.stream,
        side=told,
        calibration=glove,
        faults=place.faults,
    )
    # The device is made of its port, and tells its time to what answers there.
    answers = GloveAnswers(
        told, serial_number=name, device_time_ns=lambda: _device_time_ns(device, place.clock)
    )
    port = PtyPort(name, answer=answers.answer)
    device = MockDevice(place, source, port)
    driver = TactileGlove(side, transport=port.transport, clock=place.clock, serial_number=name)
    return MockPair(device, driver, glove.matrices(side))


class TactileGloveSource(PacketSource):
    """Packets of one glove.

    Args:
        stream: float32 [n, 320] in kPa.
        side: which hand.
        calibration: of this glove.
        faults: whose dead and drifted raw cells are planted.
    """

    edits = OurPacketEdits(PINNED)

    def __init__(
        self,
        stream: ReplayStream,
        *,
        side: Side,
        calibration: GloveCalibration,
        faults: DeviceFaults | None = None,
    ) -> None:
        if stream.descriptor.shape != (NUM_TAXELS,):
            raise ShapeError(
                f"{stream.descriptor.name}: got {stream.descriptor.shape}, expected ({NUM_TAXELS},)"
            )
        self.t_ns = stream.t_ns
        self._side = side
        self._counts = calibration.counts(stream.values, side=side)
        faults = faults or DeviceFaults()
        drifted = list(faults.drifted_taxels)
        moved = self._counts[:, drifted].astype(np.int64) + faults.drift_counts
        self._counts[:, drifted] = np.clip(moved, 0, FULL_SCALE_COUNTS)
        self._counts[:, list(faults.dead_taxels)] = 0

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        counts = self._counts[index]
        packet = Packet(VERSION, SOURCES[self._side], sequence, t_device_ns, counts.tobytes())
        return [encode_packet(MAGIC, packet)]


def _device_time_ns(device: MockDevice, clock: StationClock) -> int:
    """Time of a mock device's clock, from its last packet; any origin before the first."""
    ledger, now_ns = device.ledger, clock.now_ns()
    if not ledger.t_device_ns:
        return now_ns
    # The ledger is written by the player's thread: a column may be one row ahead.
    last = len(ledger.flipped_bits) - 1
    since_ns = now_ns - ledger.t_true_ns[last]
    skew_ns = round(since_ns * device.faults.skew_ppm * 1e-6)
    return ledger.t_device_ns[last] + since_ns + skew_ns
