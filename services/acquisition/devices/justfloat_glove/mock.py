"""A simulated glove that sends bare float32s and a tail."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from dextouch.tactile.layout import NUM_TAXELS
from services.acquisition.devices.justfloat_glove.driver import TAIL, JustFloatGloveDecoder
from services.acquisition.mocks.faults import PacketEdits, PacketFields, Pinned
from services.acquisition.mocks.replay import (
    MockPair,
    MockSlot,
    PacketSource,
    ReplayStream,
    serial_mock,
)

COUNTS_PER_KPA = 40.0
NUM_VALUES = 401
FULL_SCALE = 4095.0
# What pinned cells show.
PINNED: dict[Pinned, float] = {"stuck": 1_000.0, "saturated": FULL_SCALE}


def mock_justfloat_glove(place: MockSlot) -> MockPair:
    """A glove that sends bare float32s at the rate of the stream."""
    source = JustFloatGloveSource(place.stream, dead_taxels=place.faults.dead_taxels)
    decoder = JustFloatGloveDecoder(
        place.side,
        num_values=NUM_VALUES,
        full_scale=FULL_SCALE,
        rate_hz=place.stream.descriptor.nominal_rate_hz,
    )
    return serial_mock(place, source=source, decoder=decoder)


class JustFloatPacketEdits(PacketEdits):
    """Faults inside a packet that contains only numbers, without hand and version."""

    def fields(self, data: bytes) -> PacketFields:
        """All numbers."""
        return PacketFields(np.frombuffer(data[: -len(TAIL)], "<f4").copy())

    def packed(self, data: bytes, fields: PacketFields) -> bytes:
        """A packet of these numbers."""
        return data if fields.numbers is None else encode_justfloat(fields.numbers)


class JustFloatGloveSource(PacketSource):
    """Packets of one glove: the taxels' counts, then zeros in the slots that mean nothing.

    Args:
        stream: float32 [n, 320] in kPa.
        dead_taxels: places in the packet that read zero.
    """

    edits = JustFloatPacketEdits(PINNED)

    def __init__(self, stream: ReplayStream, *, dead_taxels: Sequence[int] = ()) -> None:
        # No device sends the negative zero that rounding leaves of noise.
        counts = np.clip(np.rint(COUNTS_PER_KPA * stream.values), 0.0, FULL_SCALE) + 0.0
        self.t_ns = stream.t_ns
        self._values = np.zeros((len(counts), NUM_VALUES), dtype="<f4")
        self._values[:, :NUM_TAXELS] = counts
        self._values[:, list(dead_taxels)] = 0.0

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet; the device sends neither sequence number nor time."""
        return [encode_justfloat(self._values[index])]


def encode_justfloat(values: Float32[np.ndarray, " n"]) -> bytes:
    """Bytes of one packet."""
    return values.astype("<f4").tobytes() + TAIL
