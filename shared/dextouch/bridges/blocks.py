"""Bounded-memory iteration over the samples of an episode or recording, for exporters."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.episodes import EpisodeReader, RecordingReader
from dextouch.streams import (
    ENCODED_UNITS,
    NO_DEVICE_TIME,
    NO_SEQUENCE,
    SampleBatch,
    encoded_values,
)

Reader = EpisodeReader | RecordingReader
BLOCK_SECONDS: Final = 1.0


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


def blocks(reader: Reader, name: str) -> Iterator[Block]:
    """Iterate over a stream in order, about one second per block; encoded images stay encoded.

    Args:
        reader: of the episode or recording.
        name: of the stream.
    """
    descriptor, stamps_ns = reader.streams[name], reader.stamps_ns(name)
    each = max(1, round(descriptor.nominal_rate_hz * BLOCK_SECONDS))
    # Samples with equal stamps stay in one block, since the reader is queried by time.
    starts = np.unique(np.searchsorted(stamps_ns, stamps_ns[::each]))
    for start, stop in zip(starts, [*starts[1:], len(stamps_ns)], strict=True):
        yield _block(reader, name, int(start), int(stop))


def _block(reader: Reader, name: str, start: int, stop: int) -> Block:
    stamps_ns = reader.stamps_ns(name)
    encoded: np.ndarray | None = None
    if reader.streams[name].unit in ENCODED_UNITS:
        encoded = encoded_values(reader.encoded_images(name, start, stop))
    if encoded is not None and isinstance(reader, EpisodeReader):
        return _of_episode(stamps_ns[start:stop], encoded)
    data = reader.read(
        name, int(stamps_ns[start]), int(stamps_ns[stop]) if stop < len(stamps_ns) else None
    )
    values = data.values if encoded is None else encoded
    if isinstance(data, SampleBatch):
        # This includes images: the reader returns device stamps only with decoded values.
        return Block(data.t_host_ns, data.t_device_ns, data.sequence, values)
    return _of_episode(data.t_ref_ns, values)


def _of_episode(t_ref_ns: np.ndarray, values: np.ndarray) -> Block:
    absent = np.full(len(t_ref_ns), NO_DEVICE_TIME, dtype=np.int64)
    unnumbered = np.full(len(t_ref_ns), NO_SEQUENCE, dtype=np.int64)
    return Block(t_ref_ns, absent, unnumbered, values)
