"""The glove families under one roof for fuzzing: how to make a packet, and how to decode."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from services.acquisition.devices.justfloat_glove import JustFloatGloveDecoder
from services.acquisition.devices.tactile_glove import (
    COMMAND_MAGIC,
    MAGIC,
    REQUEST,
    TactileGloveDecoder,
)
from services.acquisition.devices.wuji_glove import WujiGloveDecoder
from services.acquisition.drivers.packets import (
    SOURCES,
    VERSION,
    Packet,
    PacketDecoder,
    encode_packet,
)
from services.acquisition.mocks.gloves import encode_justfloat, encode_wuji

NUM_VALUES = 401
FULL_SCALE = 4095.0


@dataclass(frozen=True)
class Family:
    """One packet family; `values` of a packet made with the same generator."""

    make: Callable[[int, np.random.Generator], tuple[bytes, bytes]]
    decoder: Callable[[], object]
    has_checksum: bool = True


def _dextouch(sequence, rng):
    payload = rng.bytes(720)
    return encode_packet(MAGIC, Packet(1, 1, sequence, 10**9 + sequence, payload)), payload


def _wuji(sequence, rng):
    cells = rng.random(768, dtype=np.float32)
    cells[rng.random(768) < 0.3] = np.nan
    return encode_wuji(0, sequence, 1000 + 8 * sequence, cells.tobytes()), cells.tobytes()


def _justfloat(sequence, rng):
    # Raw counts, most of them zero, as an untouched glove sends them.
    values = rng.integers(0, 4096, NUM_VALUES) * (rng.random(NUM_VALUES) < 0.3)
    values = values.astype("<f4")
    return encode_justfloat(values), values.tobytes()


class _Requests:
    """The commands of our glove, decoded as a device decodes them."""

    def __init__(self):
        self._packets = PacketDecoder(
            COMMAND_MAGIC, min_payload=REQUEST.size, max_payload=REQUEST.size
        )
        self.statistics = self._packets.statistics

    def feed(self, data):
        return self._packets.feed(data)


def _request(sequence, rng):
    command, argument = int(rng.integers(256)), int(rng.integers(65536))
    payload = REQUEST.pack(command, argument)
    packet = Packet(VERSION, SOURCES["none"], sequence, 0, payload)
    return encode_packet(COMMAND_MAGIC, packet), payload


def _justfloat_decoder():
    return JustFloatGloveDecoder("left", num_values=NUM_VALUES, full_scale=FULL_SCALE, rate_hz=60.0)


FAMILIES = {
    "dextouch": Family(_dextouch, lambda: TactileGloveDecoder("left")),
    "wuji": Family(_wuji, lambda: WujiGloveDecoder("left")),
    "justfloat": Family(_justfloat, _justfloat_decoder, has_checksum=False),
    "requests": Family(_request, _Requests),
}


def content(item):
    """The payload bytes of what a decoder gave."""
    return item.payload if isinstance(item, Packet) else item.values.tobytes()
