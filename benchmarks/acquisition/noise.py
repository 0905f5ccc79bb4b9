"""Decoding of packets from a noisy serial line, by our decoder and the baselines."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from benchmarks.acquisition.families import Family, Feed, payload_of

BLOCK_PACKETS = 500
READ_BYTES = 4096


@dataclass(frozen=True)
class Line:
    """Error rates of a line."""

    bit_error_rate: float
    byte_loss_rate: float


@dataclass(frozen=True)
class Judgement:
    """Result of a decoder: `wrong` packets were never sent, `collateral` lost though undamaged."""

    family: str
    way: str
    sent: int
    touched: int
    delivered: int
    wrong: int
    collateral: int

    @property
    def wrong_share(self) -> float:
        """Share of wrong packets among the delivered ones."""
        return self.wrong / max(1, self.delivered)


def judge(
    family: Family,
    line: Line,
    num_packets: int,
    *,
    seed: int,
    on_block: Callable[[str], None] = lambda _: None,
) -> list[Judgement]:
    """Send packets once over the line and decode them with each decoder.

    The first and the last packets are excluded: a family without a start mark needs one packet to
    synchronize, and the last one may still be pending.
    """
    rng = np.random.default_rng(seed)
    feeds = {way: make() for way, make in family.ways.items()}
    seen = {way: np.zeros(num_packets, dtype=np.bool_) for way in feeds}
    counts = {way: [0, 0] for way in feeds}
    touched = np.zeros(num_packets, dtype=np.bool_)
    index_of: dict[int, int] = {}
    for first in range(0, num_packets, BLOCK_PACKETS):
        size = min(BLOCK_PACKETS, num_packets - first)
        packets = [family.make(first + index, rng) for index in range(size)]
        for index, packet in enumerate(packets):
            index_of[hash(packet[family.payload])] = first + index
        data, touched[first : first + size] = disturb(packets, line, rng)
        for way, feed in feeds.items():
            for payload in _decode(feed, data):
                found = index_of.get(hash(payload))
                counts[way][0] += 1
                if found is None:
                    counts[way][1] += 1
                else:
                    seen[way][found] = True
        on_block(f"{family.name}, packet {first + size}")
    judged = slice(1, num_packets - 3)
    return [
        Judgement(
            family.name,
            way,
            num_packets,
            int(touched.sum()),
            counts[way][0],
            counts[way][1],
            int((~seen[way] & ~touched)[judged].sum()),
        )
        for way in feeds
    ]


def disturb(
    packets: Sequence[bytes], line: Line, rng: np.random.Generator
) -> tuple[bytes, Bool[np.ndarray, " n"]]:
    """Apply the line's errors; returns the received bytes and a mask of damaged packets."""
    data = np.frombuffer(b"".join(packets), np.uint8).copy()
    ends = np.cumsum([len(packet) for packet in packets])
    num_bits = 8 * len(data)
    bits = np.unique(rng.integers(0, num_bits, rng.binomial(num_bits, line.bit_error_rate)))
    np.bitwise_xor.at(data, bits // 8, (1 << bits % 8).astype(np.uint8))
    lost = np.unique(rng.integers(0, len(data), rng.binomial(len(data), line.byte_loss_rate)))
    touched = np.zeros(len(packets), dtype=np.bool_)
    touched[np.searchsorted(ends, np.concatenate([bits // 8, lost]), side="right")] = True
    return np.delete(data, lost).tobytes(), touched


def count_split_differences(family: Family, line: Line, num_splits: int, *, seed: int) -> int:
    """Number of random splits of a damaged stream that change our decoder's output."""
    rng = np.random.default_rng(seed)
    packets = [family.make(index, rng) for index in range(60)]
    # Far more damage than on a real line, so that splits hit every kind of damage.
    worse = Line(30 * line.bit_error_rate, 30 * line.byte_loss_rate)
    data, _ = disturb(packets, worse, rng)
    whole = [payload_of(item) for item in family.ways["ours"]()(data)]
    different = 0
    for _ in range(num_splits):
        feed, position = family.ways["ours"](), 0
        found: list[bytes] = []
        longest = int(rng.choice([1, 3, 64, 746, 4096, 20_000]))
        while position < len(data):
            size = int(rng.integers(1, longest + 1))
            found += map(payload_of, feed(data[position : position + size]))
            position += size
        different += found != whole
    return different


def _decode(feed: Feed, data: bytes) -> list[bytes]:
    found: list[bytes] = []
    for position in range(0, len(data), READ_BYTES):
        found += map(payload_of, feed(data[position : position + READ_BYTES]))
    return found
