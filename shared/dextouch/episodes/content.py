"""Digest of a stream's samples, by which a station proves that a recording has all of its take.

It is made of the sha256 of the stream's arrays, as a commit record lists them: a station computes
them from its spool, and a store reads them from what it committed.
"""

import hashlib
from collections.abc import Mapping

from dextouch.episodes.format import (
    GOP_IMAGES,
    STAMPS,
    ArrayEntry,
    codec_of,
    sha256_hex,
    stream_arrays,
)
from dextouch.episodes.image_codecs import pack_chunk
from dextouch.schemas import StreamContent
from dextouch.streams import SampleBatch, StreamDescriptor


class ContentDigest:
    """Digest of the samples of one stream of a recording, batch by batch.

    Images of `jpeg` and `h264` streams are encoded, as in a spool.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self._codec = codec_of(descriptor)
        self._dtype = descriptor.numpy_dtype().newbyteorder("<")
        # As in `stream_arrays`: values first.
        self._columns = [hashlib.sha256() for _ in range(1 + len(STAMPS["recording"]))]
        self._group: list[bytes] = []
        self._num_samples = 0

    def add(self, batch: SampleBatch) -> None:
        """Add the next samples of the stream."""
        values, *stamps = self._columns
        self._num_samples += len(batch)
        for column, stamp in zip(stamps, STAMPS["recording"], strict=True):
            column.update(getattr(batch, stamp).astype("<i8").tobytes())
        if self._codec == "zstd":
            values.update(batch.values.astype(self._dtype, order="C", copy=False).data)
            return
        # Storage chunks of images: one of JPEG, a group of H.264.
        num_images = GOP_IMAGES if self._codec == "h264" else 1
        for image in batch.values:
            self._group.append(image)
            if len(self._group) == num_images:
                values.update(pack_chunk(self._codec, self._group))
                self._group = []

    def content(self) -> StreamContent:
        """What was added so far."""
        values, *stamps = (column.copy() for column in self._columns)
        if self._group:
            values.update(pack_chunk(self._codec, self._group))
        return _content(self._num_samples, [c.hexdigest() for c in (values, *stamps)])


def committed_content(
    descriptor: StreamDescriptor, entries: Mapping[str, ArrayEntry]
) -> StreamContent:
    """What the entries of a commit record say of a stream of a recording."""
    arrays = [entries[name] for name in stream_arrays(descriptor, "recording")]
    return _content(arrays[0].shape[0], [array.sha256 for array in arrays])


def _content(num_samples: int, digests: list[str]) -> StreamContent:
    return StreamContent(num_samples=num_samples, sha256=sha256_hex(" ".join(digests).encode()))
