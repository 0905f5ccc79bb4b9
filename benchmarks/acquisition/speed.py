"""Processor time per packet of each decoder by read size, measured in turns."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from benchmarks.acquisition.families import Family
from benchmarks.figures import Figure
from benchmarks.rounds import every_round, interleaved

WHOLE = 0
READ_SIZES = (64, WHOLE, 4096)
NUM_PACKETS = 300


def measure_speed(
    families: Sequence[Family],
    num_rounds: int,
    *,
    seed: int,
    on_step: Callable[[str], None],
) -> Mapping[tuple[str, str, int], Figure]:
    """µs a packet of processor time, by family, way and bytes a read (0: one packet)."""
    rng = np.random.default_rng(seed)
    subjects = {}
    keys = {}
    for family in families:
        packets = [family.make(index, rng) for index in range(NUM_PACKETS)]
        for way in family.ways:
            for size in READ_SIZES:
                name = f"{family.name}, {way}, {size or 'packet'}"
                subjects[name] = every_round(partial(_once, family, way, packets, size))
                keys[name] = (family.name, way, size)
    found = interleaved(subjects, num_rounds, on_step=on_step)
    return {keys[name]: Figure.of(values) for name, values in found.items()}


def _once(family: Family, way: str, packets: list[bytes], size: int) -> float:
    data = b"".join(packets)
    step = size or len(packets[0])
    portions = [data[at : at + step] for at in range(0, len(data), step)]
    feed = family.ways[way]()
    start_s = time.thread_time()
    for portion in portions:
        feed(portion)
    return (time.thread_time() - start_s) / len(packets) * 1e6
