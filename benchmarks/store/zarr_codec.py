"""JPEG codec for zarr-python, used by the compared designs."""

import asyncio
from dataclasses import dataclass

import numpy as np
import simplejpeg
from zarr.abc.codec import ArrayBytesCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer, NDBuffer
from zarr.core.common import JSON, parse_named_configuration
from zarr.registry import register_codec

from benchmarks.store.workload import JPEG_QUALITY
from dextouch.errors import InvalidInputError


@dataclass(frozen=True)
class JpegCodec(ArrayBytesCodec):
    """One image per chunk, with halved chroma resolution as in OpenCV's default.

    Works in the thread of zarr's event loop.
    """

    is_fixed_size = False
    quality: int = JPEG_QUALITY

    @classmethod
    def key(cls) -> str:
        """The codec's name in zarr.json."""
        return "dextouch_bench.jpeg"

    @classmethod
    def from_dict(cls, data: dict[str, JSON]) -> "JpegCodec":
        """The codec that zarr.json describes."""
        _, configuration = parse_named_configuration(data, cls.key())
        quality = configuration["quality"]
        if not isinstance(quality, int):
            raise InvalidInputError(f"{cls.key()}: got quality {quality!r}, expected a number")
        return cls(quality)

    def to_dict(self) -> dict[str, JSON]:
        """Configuration of the codec in zarr.json."""
        return {"name": self.key(), "configuration": {"quality": self.quality}}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """JPEG has no fixed size."""
        raise NotImplementedError

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        return self._encode(chunk_data, chunk_spec)

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        return self._decode(chunk_data, chunk_spec)

    def _encode(self, chunk: NDBuffer, spec: ArraySpec) -> Buffer:
        image = np.ascontiguousarray(chunk.as_numpy_array()).reshape(spec.shape[-3:])
        data = simplejpeg.encode_jpeg(image, quality=self.quality, colorsubsampling="420")
        return spec.prototype.buffer.from_bytes(data)

    def _decode(self, chunk: Buffer, spec: ArraySpec) -> NDBuffer:
        image = simplejpeg.decode_jpeg(chunk.to_bytes())
        return spec.prototype.nd_buffer.from_numpy_array(image.reshape(spec.shape))


@dataclass(frozen=True)
class PooledJpegCodec(JpegCodec):
    """The same codec in zarr's thread pool, so that one window uses all cores."""

    @classmethod
    def key(cls) -> str:
        """The codec's name in zarr.json."""
        return "dextouch_bench.jpeg_pool"

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        return await asyncio.to_thread(self._encode, chunk_data, chunk_spec)

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        return await asyncio.to_thread(self._decode, chunk_data, chunk_spec)


def register() -> None:
    """Register both codecs with zarr-python; may be called repeatedly."""
    for codec in (JpegCodec, PooledJpegCodec):
        register_codec(codec.key(), codec)
