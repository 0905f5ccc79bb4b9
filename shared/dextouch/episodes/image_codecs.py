"""Packing of JPEG and H.264 images into storage chunks, and decoding of chunks to pixels.

A `jpeg` storage chunk is the bytes of one JPEG image. An `h264` one is a closed group of pictures:
u32 number of images, u32 length of each access unit, the access units; little endian.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
import simplejpeg

from dextouch.episodes.format import Codec
from dextouch.episodes.video import ImageForm, decoder_of_this_thread
from dextouch.errors import CorruptDataError
from dextouch.images import jpeg_size


def pack_chunk(codec: Codec, images: Sequence[bytes]) -> bytes:
    """Pack one JPEG image, or the access units of one group of pictures, into a storage chunk."""
    if codec == "jpeg":
        return images[0]
    return struct.pack(f"<{1 + len(images)}I", len(images), *map(len, images)) + b"".join(images)


@dataclass(frozen=True)
class ImageChunks:
    """Decoder for the storage chunks of one image array.

    `shape` is [h, w, 3] of an image, `rows` the number of images per storage chunk, `what` the
    array's name in errors.
    """

    codec: Codec
    shape: tuple[int, ...]
    rows: int
    what: str

    def unpack(self, payload: bytes, number: int) -> list[bytes]:
        """Split storage chunk `number` into its encoded images, the inverse of `pack_chunk`.

        Raises:
            CorruptDataError: an invalid storage chunk.
        """
        if self.codec == "jpeg":
            return [payload]
        what = f"{self.what}: storage chunk {number}"
        count = int.from_bytes(payload[:4], "little") if len(payload) >= 4 else 0
        if not 1 <= count <= self.rows or len(payload) < 4 * (1 + count):
            raise CorruptDataError(f"{what}: got {count} images, expected 1 … {self.rows}")
        lengths = struct.unpack_from(f"<{count}I", payload, 4)
        bounds = list(accumulate(lengths, initial=4 * (1 + count)))
        if bounds[-1] != len(payload):
            raise CorruptDataError(f"{what}: images end at byte {bounds[-1]} of {len(payload)}")
        return [payload[start:stop] for start, stop in pairwise(bounds)]

    def decode(
        self, payload: bytes, number: int, places: list[int], form: ImageForm, out: np.ndarray
    ) -> None:
        """Decode images of storage chunk `number` into `out`, decoding no more than necessary.

        `places` are the ascending indices of the requested images in the chunk, `out` is uint8
        [len(places), *form.shape(shape)].

        Raises:
            CorruptDataError: invalid image data.
        """
        images = self.unpack(payload, number)
        if places[-1] >= len(images):
            raise CorruptDataError(
                f"{self.what}: storage chunk {number} holds {len(images)} images, "
                f"expected image {places[-1]}"
            )
        try:
            if self.codec == "jpeg":
                self._decode_jpeg(images[0], form, out[0])
            else:
                decoder = decoder_of_this_thread(*self.shape[:2])
                decoder.decode(images[: places[-1] + 1], places, form, out)
        except CorruptDataError as error:
            raise CorruptDataError(
                f"{self.what}: storage chunk {number}: {error.message}"
            ) from error

    def _decode_jpeg(self, data: bytes, form: ImageForm, out: np.ndarray) -> None:
        # Check the header first: the decoder allocates what it declares.
        if (size := jpeg_size(data)) != self.shape[:2]:
            raise CorruptDataError(f"got a JPEG image of {size} pixels, expected {self.shape[:2]}")
        try:
            # At half size libjpeg skips half of the DCT coefficients, which is faster than
            # averaging.
            image = simplejpeg.decode_jpeg(
                data,
                colorspace="GRAY" if form.gray else "RGB",
                min_height=out.shape[0] if form.half_size else 0,
                min_width=out.shape[1] if form.half_size else 0,
                min_factor=2 if form.half_size else 1,
            )
        except ValueError as error:
            raise CorruptDataError(
                f"{len(data)} bytes are not a complete JPEG ({error})"
            ) from error
        # A half of an odd size is rounded up there and down here.
        out[...] = image[: out.shape[0], : out.shape[1]]


def transform_pixels(images: np.ndarray, form: ImageForm) -> np.ndarray:
    """Plain uint8 images [n, h, w, 3] in another form.

    Half size is the mean of 2×2 pixels, gray the luma of ITU-R BT.601.
    """
    if form.gray:
        weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
        images = np.rint(images @ weights)[..., None].astype(np.uint8)
    if form.half_size:
        n, height, width, channels = images.shape
        even = images[:, : height // 2 * 2, : width // 2 * 2]
        blocks = even.reshape(n, height // 2, 2, width // 2, 2, channels)
        images = np.rint(blocks.mean(axis=(2, 4), dtype=np.float32)).astype(np.uint8)
    return images
