"""Packet families of gloves: packet generators, our decoders and baseline decoders."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from dextouch.streams import Sample
from services.acquisition.devices.justfloat_glove import TAIL, JustFloatGloveDecoder
from services.acquisition.devices.tactile_glove import MAGIC, PAYLOAD_BYTES, TactileGloveDecoder
from services.acquisition.devices.wuji_glove import (
    CRC_OFFSET,
    HEAD,
    MARK,
    NUM_CELLS,
    PACKET_BYTES,
    STAMPS,
    WujiGloveDecoder,
    WujiPacket,
)
from services.acquisition.drivers.base import StreamDecoder
from services.acquisition.drivers.packets import HEADER, OVERHEAD, SOURCES, VERSION, Packet
from services.acquisition.drivers.packets import encode_packet as encode_ours
from services.acquisition.mocks.gloves import encode_justfloat, encode_wuji

NUM_VALUES = 401
FULL_SCALE = 4095.0
# The most frequent byte of an untouched glove.
TOUCHED_SHARE = 0.3
NO_CELL_SHARE = 0.3


# Decoder that maps the next bytes to the samples (baselines: payloads) of completed packets.
Feed = Callable[[bytes], Sequence[bytes] | Sequence[Sample]]


@dataclass(frozen=True)
class Family:
    """A packet family on a serial line.

    `make` creates a packet from its index and a generator; `payload` is the span of its readings;
    `decoder` creates our decoder, and `rivals` are factories of others.
    """

    name: str
    has_checksum: bool
    make: Callable[[int, np.random.Generator], bytes]
    payload: slice
    decoder: Callable[[], StreamDecoder[Packet] | StreamDecoder[WujiPacket] | StreamDecoder[bytes]]
    rivals: dict[str, Callable[[], Feed]]

    @property
    def ways(self) -> dict[str, Callable[[], Feed]]:
        """Our decoder and the baselines, by name."""
        return {"ours": lambda: self.decoder().feed, **self.rivals}


class FixedLength:
    """Baseline: whatever follows a mark is a packet of the usual length; nothing is checked."""

    def __init__(self, mark: bytes, size: int, payload: slice) -> None:
        self._mark, self._size, self._payload = mark, size, payload
        self._buffer = bytearray()

    def __call__(self, data: bytes) -> Sequence[bytes]:
        """Payloads of what is taken for packets."""
        buffer = self._buffer
        buffer += data
        found: list[bytes] = []
        position = 0
        while True:
            start = buffer.find(self._mark, position)
            if start < 0 or len(buffer) < start + self._size:
                position = start if start >= 0 else max(position, len(buffer) - len(self._mark))
                break
            found.append(bytes(buffer[start : start + self._size][self._payload]))
            position = start + self._size
        del buffer[:position]
        return found


class TailAlone:
    """Baseline for packets that end with a mark: the bytes before it, if their length fits."""

    def __init__(self, mark: bytes) -> None:
        self._mark, self._rest = mark, b""

    def __call__(self, data: bytes) -> Sequence[bytes]:
        """Payloads of what is taken for packets."""
        *found, self._rest = (self._rest + data).split(self._mark)
        return found


def payload_of(item: bytes | Sample) -> bytes:
    """Readings of a decoded item."""
    return item if isinstance(item, bytes) else item.values.tobytes()


def make_families() -> tuple[Family, ...]:
    """Create the families: our own packet, one with CRC-16, one without checksum."""
    ours_payload = slice(HEADER.size, HEADER.size + PAYLOAD_BYTES)
    ours_size = OVERHEAD + PAYLOAD_BYTES
    wuji_payload = slice(HEAD.size, CRC_OFFSET - STAMPS.size)
    return (
        Family(
            "dextouch",
            has_checksum=True,
            make=_make_ours,
            payload=ours_payload,
            decoder=partial(TactileGloveDecoder, "left"),
            rivals={"mark and length": lambda: FixedLength(MAGIC, ours_size, ours_payload)},
        ),
        Family(
            "wuji",
            has_checksum=True,
            make=_make_wuji,
            payload=wuji_payload,
            decoder=partial(WujiGloveDecoder, "left"),
            rivals={"mark and length": lambda: FixedLength(MARK, PACKET_BYTES, wuji_payload)},
        ),
        Family(
            "justfloat",
            has_checksum=False,
            make=_make_justfloat,
            payload=slice(0, 4 * NUM_VALUES),
            decoder=partial(
                JustFloatGloveDecoder,
                "left",
                num_values=NUM_VALUES,
                full_scale=FULL_SCALE,
                rate_hz=60.0,
            ),
            rivals={"tail alone": lambda: TailAlone(TAIL)},
        ),
    )


def _make_ours(index: int, rng: np.random.Generator) -> bytes:
    packet = Packet(VERSION, SOURCES["left"], index, index, rng.bytes(PAYLOAD_BYTES))
    return encode_ours(MAGIC, packet)


def _make_wuji(index: int, rng: np.random.Generator) -> bytes:
    cells = rng.random(NUM_CELLS, dtype=np.float32)
    cells[: round(NO_CELL_SHARE * NUM_CELLS)] = np.nan
    return encode_wuji(0, index, 8 * index, cells.tobytes())


def _make_justfloat(index: int, rng: np.random.Generator) -> bytes:
    counts = rng.integers(0, round(FULL_SCALE) + 1, NUM_VALUES)
    counts[rng.random(NUM_VALUES) >= TOUCHED_SHARE] = 0
    return encode_justfloat(counts.astype(np.float32))
