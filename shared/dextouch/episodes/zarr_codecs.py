"""Zarr-python codecs `dextouch.jpeg` and `dextouch.h264`, for image arrays of format v2.

zarr-python finds them by this package's entry points. They only decode: `EpisodeWriter` writes.
"""

from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from zarr.abc.codec import ArrayBytesCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer, NDBuffer

from dextouch.episodes.format import ZARR_CODECS, ImageCodec
from dextouch.episodes.image_codecs import FULL_FORM, ImageGroups, unpack_group
from dextouch.errors import InvalidInputError


@dataclass(frozen=True)
class _ImageCodec(ArrayBytesCodec):
    """Decodes image chunks to uint8 [n, h, w, 3]; padding rows are zero."""

    is_fixed_size = False
    codec: ImageCodec = "jpeg"

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "_ImageCodec":
        return cls()

    def to_dict(self) -> dict[str, Any]:
        return {"name": ZARR_CODECS[self.codec]}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> NoReturn:
        """Unknown before images are encoded."""
        raise NotImplementedError

    async def _encode_single(self, chunk_array: NDBuffer, chunk_spec: ArraySpec) -> NoReturn:
        raise InvalidInputError(
            f"{ZARR_CODECS[self.codec]}: got images to encode, but this codec only reads; write "
            "through dextouch.episodes.EpisodeStore.writer"
        )

    async def _decode_single(self, chunk_bytes: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        shape, name = chunk_spec.shape, ZARR_CODECS[self.codec]
        images = np.zeros(shape, dtype=np.uint8)
        encoded = unpack_group(self.codec, chunk_bytes.to_bytes(), name)
        places, out = list(range(len(encoded))), images[: len(encoded)]
        ImageGroups(self.codec, shape[1:], name).decode(encoded, 0, places, FULL_FORM, out)
        return chunk_spec.prototype.nd_buffer.from_numpy_array(images)


@dataclass(frozen=True)
class JpegCodec(_ImageCodec):
    """`dextouch.jpeg`."""

    codec: ImageCodec = "jpeg"


@dataclass(frozen=True)
class H264Codec(_ImageCodec):
    """`dextouch.h264`."""

    codec: ImageCodec = "h264"
