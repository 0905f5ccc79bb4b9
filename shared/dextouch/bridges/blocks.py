"""A reader of an episode or a recording in, blocks of its samples with bounded memory out."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.episodes import EpisodeReader, RecordingReader
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import NO_DEVICE_TIME, NO_SEQUENCE, SampleBatch

Reader = EpisodeReader | RecordingReader
ENCODED_UNITS: Final = ("jpeg", "h264")
BLOCK_SECONDS: Final = 1.0
_MIN_NS, _MAX_NS = -(1 << 63), (1 << 63) - 1


@dataclass(frozen=True)
class Block:
    """Consecutive samples of one stream.

    `t_ns` is t_ref_ns of an episode or t_host_ns of a recording; `values` are rows of the stream,
    or for encoded images an object array of bytes.
    """

    t_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    sequence: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]

    def __len__(self) -> int:
        return len(self.t_ns)


def is_encoded(descriptor: StreamDescriptor) -> bool:
    """Whether a stream's images are kept as encoded bytes."""
    return descriptor.unit in ENCODED_UNITS


def objects(items: list[bytes]) -> Shaped[np.ndarray, " n"]:
    """Encoded images as an object array, the form that writers take."""
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array


def stamp_at(reader: Reader, name: str, index: int) -> int:
    """Time of one sample of a stream (nanoseconds), found through the reader's counts.

    Args:
        reader: of the episode or recording.
        name: of the stream.
        index: 0 … number of samples − 1.
    """
    low, high = _MIN_NS, _MAX_NS
    while low < high:
        middle = (low + high) // 2
        if reader.count(name, None, middle) > index:
            high = middle
        else:
            low = middle + 1
    return low - 1


def blocks(reader: Reader, name: str) -> Iterator[Block]:
    """All samples of a stream in order, about a second at a time; encoded images stay encoded.

    Args:
        reader: of the episode or recording.
        name: of the stream.
    """
    descriptor = reader.streams[name]
    num_samples = reader.num_samples(name)
    each = max(1, round(descriptor.nominal_rate_hz * BLOCK_SECONDS))
    edges: list[int | None] = [stamp_at(reader, name, k) for k in range(0, num_samples, each)]
    done = 0
    # Samples with the stamp of an edge belong to the block that starts there.
    for start_ns, stop_ns in zip(edges, [*edges[1:], None], strict=True):
        if start_ns == stop_ns:
            continue
        block = _read(reader, name, start_ns, stop_ns)
        if is_encoded(descriptor):
            encoded = objects(reader.encoded_images(name, done, done + len(block)))
            block = Block(block.t_ns, block.t_device_ns, block.sequence, encoded)
        done += len(block)
        yield block


def _read(reader: Reader, name: str, start_ns: int | None, stop_ns: int | None) -> Block:
    data = reader.read(name, start_ns, stop_ns)
    if isinstance(data, SampleBatch):
        return Block(data.t_host_ns, data.t_device_ns, data.sequence, data.values)
    absent = np.full(len(data), NO_DEVICE_TIME, dtype=np.int64)
    unnumbered = np.full(len(data), NO_SEQUENCE, dtype=np.int64)
    return Block(data.t_ref_ns, absent, unnumbered, data.values)
